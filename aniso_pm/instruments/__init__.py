"""What tells rather than renders: why, how well, how fast, how stable."""
