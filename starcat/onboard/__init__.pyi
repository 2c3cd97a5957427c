from starcat.onboard.layout import BYTE_ORDERS as BYTE_ORDERS
from starcat.onboard.layout import FEATURES as FEATURES
from starcat.onboard.profiles import PROFILES as PROFILES
