from starcat.database.products.blends import widths_px as widths_px
from starcat.database.products.coverage import Spread as Spread
from starcat.database.products.table import USUAL_PRODUCTS as USUAL_PRODUCTS
from starcat.database.products.tiling import FieldStars as FieldStars
