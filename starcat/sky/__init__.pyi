from starcat.sky.bodies import bodies_seen as bodies_seen
from starcat.sky.names import common_names as common_names
from starcat.sky.observer import Observer as Observer
from starcat.sky.observer import aberrated as aberrated
