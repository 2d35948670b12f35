"""Many plans: Pareto fronts, robust plans."""
