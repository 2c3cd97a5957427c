"""Tables: released schemas, and Parquet files that follow them."""
