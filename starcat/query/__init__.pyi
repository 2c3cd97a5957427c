from starcat.query.engine import Allowance as Allowance
from starcat.query.gallery import Macro as Macro
from starcat.query.gallery import NamedQuery as NamedQuery
from starcat.query.gallery import gallery as named_queries
from starcat.query.gallery import guessed as guessed
from starcat.query.gallery import macros as macros
from starcat.query.gallery import named_query as named_query
from starcat.query.locked_duckdb import BATCH_ROWS as BATCH_ROWS
from starcat.query.locked_duckdb import Columns as Columns
from starcat.query.locked_duckdb import LockedDuckdb as LockedDuckdb
from starcat.query.locked_duckdb import Rows as Rows
from starcat.query.locked_duckdb import Values as Values
from starcat.query.locked_duckdb import plain_value as plain_value
from starcat.query.names import identifier as identifier
from starcat.query.names import quoted_name as quoted_name
from starcat.query.names import sql_quoted as sql_quoted
from starcat.query.result import ResultTable as ResultTable
from starcat.query.result import column_facts as column_facts
from starcat.query.result import facts_by_name as facts_by_name
from starcat.query.session import SCRATCH_PREFIX as SCRATCH_PREFIX
from starcat.query.session import Limits as Limits
from starcat.query.session import Session as Session
from starcat.query.session import open_session as open_session
from starcat.query.statement import Statement as Statement
from starcat.query.targets import POSITION as POSITION
from starcat.query.targets import View as View

__all__ = ["named_queries"]
