"""C code of a block, for a target: export_c."""
