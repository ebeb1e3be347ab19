"""Files of records read and checked, and written."""
