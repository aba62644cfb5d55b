"""The live view: a page that shows a picture getting better, and steers it (``aniso-pm view``).

``session`` is a rendering that can be paused, stopped, questioned and begun again while others look
at it; ``watched`` one that runs elsewhere, known by its state file. ``server`` shows either. The
rendering keeps the main thread, requests have threads of their own; what they share is a
``snapshot``, which is never changed, only replaced.
"""
