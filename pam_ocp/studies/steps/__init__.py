"""The kinds of steps that a study may have; each registers in the file that defines it."""
