"""Export of a plant as an FMU, and its check."""
