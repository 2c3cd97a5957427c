from starcat.database.onboard.layout import BYTE_ORDERS as BYTE_ORDERS
from starcat.database.onboard.layout import FEATURES as FEATURES
from starcat.database.onboard.profiles import PROFILES as PROFILES
