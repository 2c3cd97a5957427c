"""What leaves starcat: other formats, and releases."""
