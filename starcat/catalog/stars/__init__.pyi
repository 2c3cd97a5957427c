from starcat.catalog.stars.star_table import floats_of as floats_of
from starcat.catalog.stars.verdict import NO_STARS as NO_STARS
from starcat.catalog.stars.verdict import Reason as Reason
from starcat.catalog.stars.verdict import rejected_path as rejected_path
