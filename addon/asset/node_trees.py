# SPDX-License-Identifier: GPL-3.0-or-later
"""Node trees, written as expressions."""

from __future__ import annotations

import bpy


class Nodes:
    """Writes node trees as expressions: every method adds a node and returns its first visible output."""

    def __init__(self, tree) -> None:
        self.tree = tree

    def add(self, kind: str, *inputs, **settings):
        """A node with its settings and its visible inputs in order (a socket, a value, None = default)."""
        node = self.tree.nodes.new(kind)
        for key, value in settings.items():
            setattr(node, key, value)
        visible = [s for s in node.inputs if s.enabled and not s.is_unavailable]
        for socket, value in zip(visible, inputs, strict=False):
            self.put(socket, value)
        count = len(self.tree.nodes)
        node.location = (190 * (count // 4), -240 * (count % 4))
        return node

    def put(self, socket, value) -> None:
        if isinstance(value, bpy.types.NodeSocket):
            self.tree.links.new(value, socket)
        elif value is not None:
            socket.default_value = value

    def out(self, kind: str, *inputs, **settings):
        return next(s for s in self.add(kind, *inputs, **settings).outputs if s.enabled)

    def math(self, operation: str, *inputs):
        return self.out("ShaderNodeMath", *inputs, operation=operation)

    def vector(self, operation: str, *inputs):
        node = self.add("ShaderNodeVectorMath", *inputs, operation=operation)
        return node.outputs["Value" if operation == "DOT_PRODUCT" else "Vector"]

    def named(self, name: str, kind: str = "FLOAT"):
        return self.out("GeometryNodeInputNamedAttribute", name, data_type=kind)

    def either(self, *truths):
        """Whether any of them is true."""
        any_of = truths[0]
        for truth in truths[1:]:
            any_of = self.out("FunctionNodeBooleanMath", any_of, truth, operation="OR")
        return any_of

    def menu(self, choice, options: dict, kind: str):
        """The option that a menu input names."""
        node = self.add("GeometryNodeMenuSwitch", data_type=kind)
        for old, name in zip(node.enum_items, options, strict=False):  # renamed, not replaced: an item keeps the
            old.name = name  # number that it was born with, and the numbers are to be indices into the options
        for name in list(options)[len(node.enum_items) :]:
            node.enum_items.new(name)
        self.put(node.inputs[0], choice)
        for name, socket in options.items():
            self.put(node.inputs[name], socket)
        return node.outputs[0]
