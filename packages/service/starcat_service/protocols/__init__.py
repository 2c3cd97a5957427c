"""The protocols of the Virtual Observatory: queries in ADQL, and the documents of TAP."""
