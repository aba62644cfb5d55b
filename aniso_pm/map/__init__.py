"""The photon map: what a photon says, where it lies, and what an ellipse holds of it.

Knows points, normals and kernels; not how light has come there (``transport``).
"""
