"""The tabs of the page, one file each; frame.py lists them."""
