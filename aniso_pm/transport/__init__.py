"""Light along paths: photons from the emitters, eye paths from the camera.

Fills a ``map`` and reads it; knows of one pass, not of pictures (``rendering``).
"""
