"""A rendering: what the scene needs, what a pilot finds best, passes, sums, and when it ends."""
