"""Jobs that use everything: the tour, the study of loads."""
