"""The rules by which stars of a star table become guide stars, one file per rule."""
