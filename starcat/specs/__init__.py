"""Specs: what a build is asked for, checked key by key."""
