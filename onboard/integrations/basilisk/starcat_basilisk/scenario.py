# SPDX-License-Identifier: MIT
"""One orbit in which the attitude control knows the sky only through the star tracker.

Truth, wheels, gyro, guidance and control are Basilisk's own modules; star tracker and filter come
from this package. Camera axes are x right, y down, z along the boresight, which is the x axis of
the body: `hillPoint` then points it at the zenith.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import erfa
import numpy as np
from Basilisk.architecture import messaging
from Basilisk.fswAlgorithms import (
    attTrackingError,
    hillPoint,
    inertial3D,
    mrpSteering,
    rateServoFullNonlinear,
    rwMotorTorque,
)
from Basilisk.simulation import imuSensor, reactionWheelStateEffector, simpleNav, spacecraft
from Basilisk.utilities import (
    RigidBodyKinematics,
    SimulationBaseClass,
    fswSetupRW,
    macros,
    orbitalMotion,
    simIncludeGravBody,
    simIncludeRW,
)

from starcat_basilisk import starcatFilter, starcatTracker
from starcat_basilisk.sky import Array, Ephemeris, stars_to, sun_and_moon

START = (2027, 3, 18, 12, 0, 0.0)  # UTC
STEP_S, FRAME_S = 0.1, 0.2
CAMERA_FROM_BODY = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])
LIMIT_MAG = 6.5  # limit of the camera; the sky is one magnitude deeper, for blends
INERTIA_KG_M2 = np.diag([24.0, 20.0, 16.0])
SEED = 20270318
OUTAGES_MIN = ((14.0, 15.0), (24.0, 24.5), (77.2, 77.7))
"""Times without frames."""


@dataclass(frozen=True)
class Leg:
    """A part of the orbit with one target."""

    name: str
    begin_min: float
    direction: Array | None  # target of the boresight; None: follow the zenith
    fastest_deg_s: float  # maximum rate of the slew to it
    is_controlled: bool = True
    settled_min: float = 5.0  # minutes from the begin until it is settled


@dataclass
class Orbit:
    """Initial state of the spacecraft, and its targets."""

    position_m: Array
    velocity_m_s: Array
    period_min: float
    tt_jd: float
    legs: list[Leg] = field(default_factory=list)


def the_orbit() -> Orbit:
    """Return a circular orbit 600 km high, and its legs."""
    earth = simIncludeGravBody.gravBodyFactory().createEarth()
    elements = orbitalMotion.ClassicElements()
    elements.a, elements.e, elements.i = 6_978_137.0, 0.0001, np.radians(97.8)
    elements.Omega, elements.omega, elements.f = np.radians(60.0), 0.0, 0.0
    place, speed = orbitalMotion.elem2rv(earth.mu, elements)
    period_min = 2.0 * np.pi * np.sqrt(elements.a**3 / earth.mu) / 60.0
    utc = erfa.dtf2d("UTC", *START)
    tt_jd = float(sum(erfa.taitt(*erfa.utctai(*utc))))
    orbit = Orbit(np.asarray(place), np.asarray(speed), period_min, tt_jd)
    orbit.legs = _legs(orbit)
    return orbit


def _legs(orbit: Orbit) -> list[Leg]:
    up, ahead = _unit(orbit.position_m), _unit(orbit.velocity_m_s)
    pole = np.cross(up, ahead)
    sun_m = sun_and_moon(orbit.tt_jd, 0.0)[0]
    away = -pole if pole @ sun_m > 0.0 else pole
    moon = _unit(sun_and_moon(orbit.tt_jd, 35.0 * 60.0)[2])
    beside = _unit(np.cross(moon, sun_m))

    def along(minute: float) -> Array:
        turn = 2.0 * np.pi * minute / orbit.period_min
        return np.cos(turn) * up + np.sin(turn) * ahead

    def off_the_moon(angle_deg: float) -> Array:
        return _unit(moon + np.tan(np.radians(angle_deg)) * beside)

    return [
        Leg("tumbling, nothing controlled", 0.0, None, 0.0, is_controlled=False),
        Leg("open sky", 2.0, away, 0.5, settled_min=6.0),
        Leg("a slew of 50 deg", 11.0, _unit(away + 1.2 * along(11.0)), 0.3),
        Leg("4 deg beside the Moon", 20.0, off_the_moon(4.0), 0.7),
        Leg("the Moon through the field", 29.0, off_the_moon(-4.0), 0.03, settled_min=7.0),
        Leg("a place that the Earth covers", 39.0, along(16.5), 1.0),
        Leg("along with the zenith", 60.0, None, 1.5),
        Leg("a fast slew", 77.0, _unit(away - 0.8 * along(50.0)), 2.0),
        Leg("open sky again", 88.0, away, 0.5),
    ]


def _unit(vector: Array) -> Array:
    return np.asarray(vector / np.linalg.norm(vector))


def _reference(direction: Array) -> list[float]:
    """Return the attitude, as MRPs, with the boresight in a direction."""
    across = np.eye(3)[np.argmin(np.abs(direction))]
    y = _unit(np.cross(direction, across))
    return list(RigidBodyKinematics.C2MRP(np.array([direction, y, np.cross(direction, y)])))


def simulate(
    image: Path, minutes: float, seed: int = SEED, *, with_prior: bool = True
) -> tuple[Orbit, Any, Any]:
    """Fly the orbit, or its first minutes; return orbit, recorded data and the star tracker.

    Without a prior every frame is identified as if the tracker had just been switched on.
    """
    orbit = the_orbit()
    sim = SimulationBaseClass.SimBaseClass()
    process = sim.CreateNewProcess("orbit")
    for name, step_s, priority in (
        ("bodies", 1.0, 40),
        ("dynamics", STEP_S, 30),
        ("sensors", FRAME_S, 20),
        ("control", FRAME_S, 10),
        ("record", FRAME_S, 0),
    ):
        process.addTask(sim.CreateNewTask(name, macros.sec2nano(step_s)), priority)
    parts = SimpleNamespace()
    _add_spacecraft(sim, parts, orbit)
    _add_sensors(sim, parts, orbit, image, seed)
    if with_prior:
        parts.tracker.navAttInMsg.subscribeTo(parts.filter.navAttOutMsg)
    _add_control(sim, parts)
    records = SimpleNamespace(
        truth=parts.craft.scStateOutMsg.recorder(),
        frames=parts.tracker.frameOutMsg.recorder(),
        known=parts.filter.navAttOutMsg.recorder(),
    )
    for recorder in vars(records).values():
        sim.AddModelToTask("record", recorder)
    sim.InitializeSimulation()
    for leg, following in zip(orbit.legs, [*orbit.legs[1:], None], strict=True):
        if leg.begin_min >= minutes:
            break
        _turn_to(sim, parts, leg)
        end_min = minutes if following is None else min(minutes, following.begin_min)
        sim.ConfigureStopTime(macros.min2nano(end_min))
        sim.ExecuteSimulation()
    return orbit, records, parts.tracker


def _turn_to(sim: Any, parts: Any, leg: Leg) -> None:
    if not leg.is_controlled:
        sim.disableTask("control")
        return
    sim.enableTask("control")
    parts.steering.omega_max = np.radians(leg.fastest_deg_s)
    if leg.direction is None:
        parts.error.attRefInMsg.subscribeTo(parts.zenith.attRefOutMsg)
    else:
        parts.inertial.sigma_R0N = _reference(leg.direction)
        parts.error.attRefInMsg.subscribeTo(parts.inertial.attRefOutMsg)


def _add_spacecraft(sim: Any, parts: Any, orbit: Orbit) -> None:
    craft = parts.craft = spacecraft.Spacecraft()
    craft.ModelTag = "craft"
    craft.hub.mHub = 180.0
    craft.hub.IHubPntBc_B = INERTIA_KG_M2.tolist()
    gravity = parts.gravity = simIncludeGravBody.gravBodyFactory()
    gravity.createEarth().isCentralBody = True
    gravity.addBodiesTo(craft)
    craft.hub.r_CN_NInit = orbit.position_m.tolist()
    craft.hub.v_CN_NInit = orbit.velocity_m_s.tolist()
    craft.hub.sigma_BNInit = [[0.3], [-0.2], [0.4]]
    craft.hub.omega_BN_BInit = np.radians([[0.3], [-0.2], [0.25]]).tolist()
    factory = parts.factory = simIncludeRW.rwFactory()
    for axis in np.eye(3):
        factory.create("Honeywell_HR14", axis.tolist(), maxMomentum=25.0, Omega=300.0)
    parts.wheels = reactionWheelStateEffector.ReactionWheelStateEffector()
    factory.addToSpacecraft("wheels", parts.wheels, craft)
    sim.AddModelToTask("dynamics", parts.wheels)
    sim.AddModelToTask("dynamics", craft)


def _add_sensors(sim: Any, parts: Any, orbit: Orbit, image: Path, seed: int) -> None:
    bodies = parts.bodies = Ephemeris(orbit.tt_jd)
    sim.AddModelToTask("bodies", bodies)
    nav = parts.nav = simpleNav.SimpleNav()  # orbit from a GPS receiver
    nav.PMatrix = np.diag([3.0] * 3 + [0.03] * 3 + [0.0] * 12).tolist()
    nav.walkBounds = [[10.0]] * 3 + [[0.1]] * 3 + [[0.0]] * 12
    nav.RNGSeed = seed + 1
    nav.scStateInMsg.subscribeTo(parts.craft.scStateOutMsg)
    gyro = parts.gyro = imuSensor.ImuSensor()
    gyro.AMatrixGyro = np.zeros((3, 3)).tolist()  # its noise is white
    gyro.PMatrixGyro = np.diag([1e-5 / np.sqrt(FRAME_S)] * 3).tolist()
    gyro.senRotBias = (np.radians([[4.0], [-6.0], [5.0]]) / 3600.0).tolist()
    gyro.RNGSeed = seed + 2
    gyro.scStateInMsg.subscribeTo(parts.craft.scStateOutMsg)
    tracker = parts.tracker = starcatTracker.StarcatTracker()
    tracker.loadImage(str(image))
    stars = stars_to(LIMIT_MAG + 1.0)
    tracker.setSky(stars.directions.ravel().tolist(), stars.mag.tolist(), stars.ids.tolist())
    tracker.setOutages([60.0 * minute for outage in OUTAGES_MIN for minute in outage])
    tracker.dcm_CB = CAMERA_FROM_BODY.tolist()
    tracker.limitMag = LIMIT_MAG
    tracker.RNGSeed = seed
    tracker.scStateInMsg.subscribeTo(parts.craft.scStateOutMsg)
    tracker.sunInMsg.subscribeTo(bodies.sun)
    tracker.moonInMsg.subscribeTo(bodies.moon)
    tracker.navTransInMsg.subscribeTo(nav.transOutMsg)
    estimate = parts.filter = starcatFilter.StarcatFilter()
    estimate.frameInMsg.subscribeTo(tracker.frameOutMsg)
    estimate.imuInMsg.subscribeTo(gyro.sensorOutMsg)
    for model in (nav, gyro, tracker, estimate):
        sim.AddModelToTask("sensors", model)


def _add_control(sim: Any, parts: Any) -> None:
    zenith = parts.zenith = hillPoint.hillPoint()
    zenith.transNavInMsg.subscribeTo(parts.nav.transOutMsg)
    parts.inertial = inertial3D.inertial3D()
    error = parts.error = attTrackingError.attTrackingError()
    error.attNavInMsg.subscribeTo(parts.filter.navAttOutMsg)
    error.attRefInMsg.subscribeTo(parts.inertial.attRefOutMsg)
    steering = parts.steering = mrpSteering.mrpSteering()
    steering.K1, steering.K3, steering.omega_max = 0.2, 0.75, 0.01
    steering.ignoreOuterLoopFeedforward = False
    steering.guidInMsg.subscribeTo(error.attGuidOutMsg)
    servo = parts.servo = rateServoFullNonlinear.rateServoFullNonlinear()
    servo.Ki, servo.P, servo.integralLimit = 1.0, 20.0, 0.2
    servo.knownTorquePntB_B = [0.0, 0.0, 0.0]
    vehicle = messaging.VehicleConfigMsgPayload()
    vehicle.ISCPntB_B = INERTIA_KG_M2.ravel().tolist()
    parts.vehicle = messaging.VehicleConfigMsg().write(vehicle)
    fswSetupRW.clearSetup()
    for wheel in parts.factory.rwList.values():
        fswSetupRW.create(np.asarray(wheel.gsHat_B).ravel().tolist(), wheel.Js, 0.2)
    parts.wheel_message = fswSetupRW.writeConfigMessage()
    servo.guidInMsg.subscribeTo(error.attGuidOutMsg)
    servo.vehConfigInMsg.subscribeTo(parts.vehicle)
    servo.rwParamsInMsg.subscribeTo(parts.wheel_message)
    servo.rwSpeedsInMsg.subscribeTo(parts.wheels.rwSpeedOutMsg)
    servo.rateSteeringInMsg.subscribeTo(steering.rateCmdOutMsg)
    motors = parts.motors = rwMotorTorque.rwMotorTorque()
    motors.controlAxes_B = np.eye(3).ravel().tolist()
    motors.rwParamsInMsg.subscribeTo(parts.wheel_message)
    motors.vehControlInMsg.subscribeTo(servo.cmdTorqueOutMsg)
    parts.wheels.rwMotorCmdInMsg.subscribeTo(motors.rwMotorTorqueOutMsg)
    for model in (zenith, parts.inertial, error, steering, servo, motors):
        sim.AddModelToTask("control", model)
