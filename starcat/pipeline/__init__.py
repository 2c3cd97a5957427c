"""Pipeline: a spec and archive files become a verified database."""
