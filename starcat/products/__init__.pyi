from starcat.products.blends import widths_px as widths_px
from starcat.products.coverage import CoverageSummary as CoverageSummary
from starcat.products.coverage import Spread as Spread
from starcat.products.table import USUAL_PRODUCTS as USUAL_PRODUCTS
from starcat.products.tiling import FieldStars as FieldStars
