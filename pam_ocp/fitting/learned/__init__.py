"""What physics leaves out, learned from records."""
