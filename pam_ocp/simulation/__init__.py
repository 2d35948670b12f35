"""simulate, many at once, and the comparison with records."""
