"""The region of the eye: materials and textures as geometry and numbers, without any renderer."""
