from starcat.simulation.selftest import rates_of as rates_of
from starcat.simulation.selftest import self_test as self_test
from starcat.simulation.selftest import wilson_interval as wilson_interval
from starcat.simulation.simulate import Noise as Noise
from starcat.simulation.simulate import SimulatedFrame as SimulatedFrame
from starcat.simulation.simulate import Sky as Sky
from starcat.simulation.simulate import simulate_frame as simulate_frame
from starcat.simulation.simulate import simulate_frames as simulate_frames
