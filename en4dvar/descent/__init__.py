"""Down to the minimum of J: where to start, which way, how far."""
