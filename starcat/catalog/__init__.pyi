from starcat.catalog.ingest import ingest_options as ingest_options
from starcat.catalog.ingest import write_star_tables as write_star_tables
from starcat.catalog.source import data_source as data_source
from starcat.catalog.source import map_of as map_of
from starcat.catalog.source import source_names as source_names
from starcat.catalog.source import star_sources as star_sources
from starcat.catalog.source_files import SourceFiles as SourceFiles
from starcat.catalog.source_files import locate as locate
