"""Processes of the service: for reading uploads, for making files of answers, and for jobs."""
