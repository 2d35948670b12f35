"""Methods without physics: Newton, collocation, integrators, events."""
