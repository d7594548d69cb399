"""What comes in: data files, units, windows; settings to inverse problems."""
