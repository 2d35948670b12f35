"""Kalman filters and moving horizon."""
