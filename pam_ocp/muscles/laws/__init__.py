"""Force laws, one file each."""
