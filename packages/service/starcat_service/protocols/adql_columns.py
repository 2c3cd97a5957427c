"""The columns that a query returns, and their descriptions: names and scopes of a syntax tree."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from sqlglot import exp

from starcat.errors import quoted, suggest
from starcat_service.protocols.adql_grammar import AdqlRefusal
from starcat_service.protocols.tables import Tables, TapColumn

Columns = tuple[TapColumn, ...]


@dataclass(frozen=True)
class Source:
    """A table or subquery after FROM."""

    name: str  # its alias or the name of the table, lower case; empty without a name
    columns: Columns | None  # None if they are not known


class Names:
    """The meaning of the names in a query."""

    def __init__(self, tables: Tables, tree: exp.Expr) -> None:
        self._tables = tables
        self._select: dict[int, exp.Select | None] = {}
        self._sources_of: dict[int, list[Source]] = {}
        # From the root on, so that no part has to search upwards through many others.
        for part in tree.walk():
            above = self._select.get(id(part.parent))
            self._select[id(part)] = part if isinstance(part, exp.Select) else above

    def resolve(self, table: exp.Table) -> None:
        """Replace the name of a table by its full name in the session."""
        if not table.db and self._common(table, table.name) is not None:
            return
        tap_table = self._tables.find(table.db, table.name)
        if tap_table is None:
            name = f"{table.db}.{table.name}" if table.db else table.name
            names = self._tables.names()
            raise AdqlRefusal(
                f"no table {quoted(name)}; {suggest(name, names)}TAP_SCHEMA.tables lists the "
                f"{len(names)} that there are, each with its schema",
                table,
            )
        view = tap_table.view or tap_table.name
        if not table.alias and (not table.db or view != tap_table.name):
            table.set("alias", exp.TableAlias(this=exp.to_identifier(table.name, quoted=True)))
        table.set("this", exp.to_identifier(view, quoted=True))
        table.set("db", exp.to_identifier(tap_table.schema, quoted=True))

    def shorten(self, column: exp.Column) -> None:
        """Drop the schema of a column whose view has another name than its table."""
        tap_table = self._tables.find(column.db, column.table) if column.db else None
        if tap_table is not None and tap_table.view:
            column.set("db", None)

    def columns(self, query: exp.Expr) -> Columns | None:
        """Return the columns that a query returns."""
        while isinstance(query, (exp.SetOperation, exp.Subquery)):
            query = query.this
        if not isinstance(query, exp.Select):
            return None
        columns: list[TapColumn] = []
        for number, part in enumerate(query.expressions, start=1):
            more = self._projected(query, part, number)
            if more is None:
                return None
            columns += more
        return tuple(columns)

    def column(self, column: exp.Column) -> TapColumn | None:
        """Return the description of a column that a query names."""
        for select in self._around(column):
            tap_column = self._in(select, column)
            if tap_column is not None:
                return tap_column
        return None

    def check(self, column: exp.Column) -> None:
        """Check that the query can see a column."""
        if isinstance(column.this, exp.Star) or self.column(column) is not None:
            return
        names: set[str] = set()
        around = self._around(column)
        if not around:
            return  # the ORDER BY of several queries names columns of the answer
        for select in around:
            names |= {part.alias.lower() for part in select.expressions if part.alias}
            for source in self.sources(select):
                if source.columns is None:
                    return
                if not column.table or column.table.lower() == source.name:
                    names |= {tap_column.name.lower() for tap_column in source.columns}
        if column.name.lower() in names:
            return
        where = f" in {quoted(column.table)}" if column.table else ""
        raise AdqlRefusal(
            f"no column {quoted(column.name)}{where}; {suggest(column.name.lower(), names)}"
            f"{'there are ' + ', '.join(sorted(names)[:12]) if names else 'no table has the name'}",
            column,
        )

    def _around(self, part: exp.Expr) -> list[exp.Select]:
        """Return the queries that contain a part, from the innermost out."""
        selects: list[exp.Select] = []
        select = self._select.get(id(part))
        while select is not None:
            selects.append(select)
            select = self._select.get(id(select.parent)) if select.parent else None
        return selects

    def sources(self, select: exp.Select) -> list[Source]:
        """Return the tables and subqueries after FROM in a query."""
        if id(select) not in self._sources_of:
            first = select.args.get("from_")
            parts = [*([first] if first else ()), *(select.args.get("joins") or ())]
            sources = [source for part in parts for source in self._sources(part.this)]
            self._sources_of[id(select)] = sources
        return self._sources_of[id(select)]

    def _sources(self, part: exp.Expr) -> Iterator[Source]:
        if isinstance(part, exp.Table):
            yield Source((part.alias or part.name).lower(), self._renamed(part, self._of(part)))
        elif isinstance(part, exp.Subquery):
            if isinstance(part.this, (exp.Table, exp.Subquery)) and not part.alias:
                yield from self._sources(part.this)
            else:
                columns = self._renamed(part, self.columns(part.this))
                yield Source(part.alias.lower(), columns)
        for join in part.args.get("joins") or ():
            yield from self._sources(join.this)

    def _of(self, table: exp.Table) -> Columns | None:
        if not table.db and (common := self._common(table, table.name)) is not None:
            return self._renamed(common, self.columns(common.this))
        tap_table = self._tables.find(table.db, table.name)
        return tap_table.columns if tap_table else None

    def _renamed(self, part: exp.Expr, columns: Columns | None) -> Columns | None:
        """Return columns with the names that an alias gives them."""
        alias = part.args.get("alias")
        names = [identifier.name for identifier in alias.args.get("columns") or ()] if alias else []
        if not names or columns is None or len(names) > len(columns):
            return columns
        renamed = tuple(column.named(name) for column, name in zip(columns, names, strict=False))
        return renamed + columns[len(names) :]

    def _common(self, part: exp.Expr, name: str) -> exp.CTE | None:
        """Return the query of WITH that a name refers to at a position in the query."""
        child: exp.Expr = part
        parent = part.parent
        while parent is not None:
            common = parent.args.get("with_")
            if common is not None:
                before = list(common.expressions)
                if child is common:
                    inside = part.find_ancestor(exp.CTE)
                    while inside is not None and inside.parent is not common:
                        inside = inside.find_ancestor(exp.CTE)
                    before = before[: before.index(inside)] if inside in before else before
                for earlier in reversed(before):
                    if earlier.alias.lower() == name.lower():
                        cte: exp.CTE = earlier
                        return cte
            child, parent = parent, parent.parent
        return None

    def _projected(self, query: exp.Select, part: exp.Expr, number: int) -> list[TapColumn] | None:
        if isinstance(part, exp.Star) or (isinstance(part, exp.Column) and part.name == "*"):
            joins = query.args.get("joins", ())
            if any(join.args.get("using") or join.args.get("method") for join in joins):
                return None
            table = part.table.lower() if isinstance(part, exp.Column) else ""
            sources = [s for s in self.sources(query) if not table or s.name == table]
            columns: list[TapColumn] = []
            for source in sources:
                if source.columns is None:
                    return None
                columns += source.columns
            return columns
        value = part.this if isinstance(part, exp.Alias) else part
        name = part.alias or _default_name(value, number)
        column = self._in(query, value) if isinstance(value, exp.Column) else None
        return [column.named(name) if column else TapColumn.unknown(name)]

    def _in(self, select: exp.Select, column: exp.Column) -> TapColumn | None:
        table = column.table.lower()
        for source in self.sources(select):
            if table and table != source.name:
                continue
            for tap_column in source.columns or ():
                if tap_column.name.lower() == column.name.lower():
                    return tap_column
        return None


def _default_name(value: exp.Expr, number: int) -> str:
    if isinstance(value, exp.Column):
        return value.name
    if isinstance(value, exp.Anonymous):
        return f"{value.name.lower()}_{number}"
    return f"col_{number}"
