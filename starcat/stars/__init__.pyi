from starcat.stars.star_table import floats_of as floats_of
from starcat.stars.verdict import Reason as Reason
from starcat.stars.verdict import rejected_path as rejected_path
