from starcat.selection.ruleset import ALL_REASONS as ALL_REASONS
