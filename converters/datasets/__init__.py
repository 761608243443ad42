"""One module per dataset; convert.py names them."""
