"""A problem on a mesh: collocation and shooting."""
