"""A run from start to end: directory, lock, work list, progress, interruption, resumption."""
