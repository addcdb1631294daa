"""The eye region: materials and textures as geometry and numbers, without any renderer."""
