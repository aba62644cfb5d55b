"""The gallery: scenes with their meshes, textures and references; see README.md."""
