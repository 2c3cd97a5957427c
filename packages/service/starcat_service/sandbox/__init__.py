"""Processes of the service's own: for what reads uploads, makes files of answers, and does jobs."""
