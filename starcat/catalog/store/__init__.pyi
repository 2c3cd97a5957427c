from starcat.catalog.store.cluster import cluster as dask_cluster
from starcat.catalog.store.ingest import ingest_to_store as ingest_to_store
from starcat.catalog.store.layout import is_store as is_store
from starcat.catalog.store.plan import StoreOptions as StoreOptions
from starcat.catalog.store.reading import read_catalog as read_catalog

__all__ = ["dask_cluster"]
