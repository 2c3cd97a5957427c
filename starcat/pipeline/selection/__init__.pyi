from starcat.pipeline.selection.ruleset import ALL_REASONS as ALL_REASONS
from starcat.pipeline.selection.ruleset import form_fields as form_fields
