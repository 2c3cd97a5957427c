"""The rules of selection, one module per rule; the module is all that a rule needs.

`starcat.pipeline.selection.ruleset` has the list of rules, and the class with their keys. The names
of a module are:

``STEP``
    Name of the row in the report's table of filters. Neighbouring rules can share a row.
``REASONS``
    `RuleReason` of everything that the rule can reject a star for.
``COLUMNS``
    By key of the rule: the columns of the star table without which the key rejects nothing. If the
    spec states the key and no star has a value in these columns, the build says so. Columns that
    every star has, such as its direction, are not listed.
``KEYS``, ``TABLE``
    The `Section` with the keys of the rule, and the name of its table in ``[selection]``. Without
    ``TABLE`` the keys stand in ``[selection]`` itself. Rules can share a table. `Selection` has
    ``KEYS`` as a base class, or the table as a field. A new section has ``is_later = True``, and
    keys that stand in ``[selection]`` itself are in ``later_keys``, so that specs without them are
    recorded as before.
``FORM``
    A `FormField` for each key that the form of the service shows, by the name of the key.
``reject(context, keys)``
    Returns a `Rejection` for each reason, or None if the spec does not use the rule. ``keys`` is
    the section ``KEYS``.
``combine(context, keys)``
    Changes the star table before any rule rejects stars, as merging does.
``check(selection)``, ``check_spec(spec)``
    Raise a `ValueError` if keys of ``[selection]``, or of the whole spec, contradict each other.

All names but ``STEP``, ``REASONS`` and ``reject`` can be left out.
"""
