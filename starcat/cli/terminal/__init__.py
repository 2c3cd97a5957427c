"""What people see at a terminal: tables, bars, prompts; and JSON for machines."""
