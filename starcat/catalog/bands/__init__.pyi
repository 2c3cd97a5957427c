from starcat.catalog.bands.response import response_from_text as response_from_text
from starcat.catalog.bands.response import shipped as shipped
from starcat.catalog.bands.response import shipped_names as shipped_names
