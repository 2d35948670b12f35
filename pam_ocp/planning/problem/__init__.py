"""What the user said, as conditions and an objective."""
