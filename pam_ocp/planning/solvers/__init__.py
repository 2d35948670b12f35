"""IPOPT, Newton's method, compiled functions; diagnosis and multipliers."""
