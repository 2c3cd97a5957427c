from starcat.frames.sky.bodies import bodies_seen as bodies_seen
from starcat.frames.sky.names import common_names as common_names
from starcat.frames.sky.observer import Observer as Observer
from starcat.frames.sky.observer import aberrated as aberrated
