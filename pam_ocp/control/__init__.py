"""Controllers for plants and what tells how good they are. Each name is imported from its
module.
"""
