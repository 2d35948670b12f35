"""Points of rest, paths of them, and linear systems there."""
