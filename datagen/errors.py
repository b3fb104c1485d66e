# SPDX-License-Identifier: GPL-3.0-or-later
"""What is raised for bad input."""


class InputError(ValueError):
    """Something the user gave cannot be used. The message is one sentence that names the file, says what
    is wrong and what to do; the command line prints it and exits with code 2."""
