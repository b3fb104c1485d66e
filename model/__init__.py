"""First floor: views become Gaussians4D become views. torch; never bpy."""
