"""A walking figure: a body of rounded limbs and a lofted trunk, posed by the phase of its gait.

Body axes: x ahead, y to the left, z up; the origin lies on the floor between the feet. Lengths are metres.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from studio.geometry import Look, Parts, turn_about_z

STRIDE_M = 1.30
"""Way of one full cycle, two steps: it fits the legs' swing, so that the feet hardly slide"""
THIGH, SHIN, UPPER_ARM, FOREARM = 0.43, 0.42, 0.29, 0.25
TRUNK = np.array(
    [
        # height above the hips, half depth, half width, how far the ring lies ahead
        (-0.09, 0.112, 0.160, -0.005),
        (0.02, 0.118, 0.162, 0.000),
        (0.12, 0.104, 0.146, 0.008),
        (0.20, 0.104, 0.146, 0.010),
        (0.30, 0.116, 0.166, 0.006),
        (0.38, 0.116, 0.180, 0.000),
        (0.44, 0.100, 0.182, -0.006),
        (0.485, 0.076, 0.140, -0.008),
        (0.515, 0.058, 0.075, -0.006),
        (0.53, 0.050, 0.052, -0.004),
    ]
)
AROUND = np.linspace(0, 2 * np.pi, 23)


@dataclass(frozen=True)
class Clothes:
    """Who is who."""

    shirt: str
    trousers: tuple[float, float, float]
    """Tint of the denim"""
    skin: tuple[float, float, float]
    hair: tuple[float, float, float]
    shoes: tuple[float, float, float]
    height: float = 1.0
    """Factor on all lengths; 1 stands 1.75 m tall"""


@dataclass(frozen=True)
class Pose:
    """Where a figure is and what its limbs do."""

    place: tuple[float, float]
    """World x and y"""
    heading_rad: float
    """Direction of x ahead, counter-clockwise from the world's x"""
    phase_rad: float
    """Of the gait: a cycle is two steps"""
    gait: float
    """0 stands, 1 walks"""
    wave: float = 0.0
    """0: the right arm swings; 1: it is raised"""
    wave_rad: float = 0.0
    """Angle of the raised forearm"""
    gaze_rad: float = 0.0
    """Turn of the head to the left"""


def add_figure(parts: Parts, owner: int, clothes: Clothes, pose: Pose) -> np.ndarray:
    """Add a posed figure; returns balls that stand for it where it darkens its surroundings, float64 [B, 4]."""
    body = _Body(parts, owner, clothes, pose)
    feet = [body.add_leg(side) for side in (1, -1)]
    body.add_trunk()
    for side in (1, -1):
        body.add_arm(side)
    body.add_head()
    trunk = body.world(np.array([0.0, 0.0, body.hips + 0.2]))
    hips = body.world(np.array([0.0, 0.0, body.hips - 0.1]))
    rows = [(*foot, 0.10) for foot in feet] + [(*hips, 0.17), (*trunk, 0.18)]
    balls: np.ndarray = np.array(rows) * np.array([1, 1, 1, clothes.height])
    return balls


class _Body:
    """The figure's frame and how to hang parts on it."""

    def __init__(self, parts: Parts, owner: int, clothes: Clothes, pose: Pose) -> None:
        self.parts, self.owner, self.clothes, self.pose = parts, owner, clothes, pose
        self.turn = turn_about_z(pose.heading_rad)
        lowest = min(self._foot(side)[1:, 2].min() for side in (1, -1))
        self.hips = 0.045 - lowest
        """The lower foot touches the floor"""
        self.twist = 0.16 * pose.gait * np.sin(pose.phase_rad)

    def world(self, point: np.ndarray) -> np.ndarray:
        place: np.ndarray = np.array([*self.pose.place, 0.0]) + self.clothes.height * (point @ self.turn.T)
        return place

    def add_leg(self, side: int) -> np.ndarray:
        """Thigh, shin and shoe; returns the shoe's middle in the world."""
        cloth = Look("denim", (1.0, 1.4), tint=self.clothes.trousers)
        knee, heel, toe = self._foot(side) + np.array([0, 0, self.hips])
        hip = np.array([0.0, side * 0.088, self.hips])
        ankle = heel + np.array([0.045, 0, 0.055])
        self._limb(hip, knee, (0.088, 0.058), cloth)
        self._limb(knee, ankle, (0.057, 0.042), cloth)
        self._limb(heel, toe, (0.044, 0.036), Look("white", (2.0, 1.0), tint=self.clothes.shoes))
        return self.world((heel + toe) / 2)

    def add_trunk(self) -> None:
        self._ellipsoid(
            np.array([-0.005, 0, self.hips - 0.02]),
            (0.118, 0.166, 0.12),
            Look("denim", (2.0, 0.7), tint=self.clothes.trousers),
        )
        self.parts.sheet(self.owner, self.world(self._rings()), Look(self.clothes.shirt), closed=True)

    def add_arm(self, side: int) -> None:
        """Sleeve, forearm and hand; the right arm may be raised."""
        shoulder = self._on_trunk(np.array([-0.006, side * 0.178, 0.425]))
        elbow, hand = self._arm(side, shoulder)
        self._limb(shoulder, elbow, (0.056, 0.044), Look(self.clothes.shirt, (1.0, 0.6), (0.0, 0.3)))
        skin = Look("skin", (2.0, 2.0), tint=self.clothes.skin)
        self._limb(elbow, hand, (0.040, 0.029), skin)
        along = (hand - elbow) / np.linalg.norm(hand - elbow)
        self._limb(hand + 0.015 * along, hand + 0.095 * along, (0.034, 0.024), skin)

    def add_head(self) -> None:
        skin = Look("skin", (2.0, 2.0), tint=self.clothes.skin)
        turn = turn_about_z(self.pose.gaze_rad + 0.3 * self.twist)
        crown = np.array([0.012, 0.0, self.hips + 0.665])
        self._limb(np.array([-0.004, 0, self.hips + 0.49]), crown - [0.01, 0, 0.09], (0.056, 0.052), skin)
        self._ellipsoid(crown, (0.094, 0.076, 0.116), Look("face", tint=self.clothes.skin), turn)
        hair = Look("hair", (2.0, 1.0), tint=self.clothes.hair)
        self._ellipsoid(crown + turn @ [-0.024, 0, 0.026], (0.094, 0.084, 0.112), hair, turn)
        self._ellipsoid(crown + turn @ [0.091, 0, -0.012], (0.014, 0.009, 0.020), skin, turn)
        for side in (1, -1):
            self._ellipsoid(crown + turn @ [0.0, side * 0.078, -0.012], (0.020, 0.012, 0.030), skin, turn)

    def _foot(self, side: int) -> np.ndarray:
        """Knee, heel and toe [3, 3] of a leg, in the body's frame, with the hips at height 0."""
        pose = self.pose
        phase = pose.phase_rad + (0 if side > 0 else np.pi)
        swing = 0.40 * pose.gait * np.sin(phase)
        bend = 0.06 + pose.gait * 0.42 * (1 + np.cos(phase + 0.35)) * 0.9
        hip = np.array([0.0, side * 0.088, 0.0])
        knee = hip + THIGH * np.array([np.sin(swing), 0, -np.cos(swing)])
        ankle = knee + SHIN * np.array([np.sin(swing - bend), 0, -np.cos(swing - bend)])
        tilt = 0.75 * (swing - bend) + 0.05
        heel = ankle - [0.045, 0, 0.055]
        toe = heel + 0.185 * np.array([np.cos(tilt), side * 0.12, np.sin(tilt)])
        return np.stack([knee, heel, toe])

    def _arm(self, side: int, shoulder: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Elbow and wrist in the body's frame."""
        pose = self.pose
        phase = pose.phase_rad + (np.pi if side > 0 else 0)
        swing = pose.gait * 0.42 * np.sin(phase) + 0.03
        bend = 0.30 + 0.18 * pose.gait * (1 + np.sin(phase))
        hanging = np.array([np.sin(swing), side * 0.16, -np.cos(swing)])
        lower = np.array([np.sin(swing + bend), side * 0.06, -np.cos(swing + bend)])
        if side < 0 and pose.wave > 0:
            raised = np.array([0.15, -0.80, 0.58])
            hanging = _towards(hanging, raised, pose.wave)
            lower = _towards(lower, np.array([0.12, -np.sin(pose.wave_rad), np.cos(pose.wave_rad)]), pose.wave)
        elbow = shoulder + UPPER_ARM * hanging / np.linalg.norm(hanging)
        return elbow, elbow + FOREARM * lower / np.linalg.norm(lower)

    def _rings(self) -> np.ndarray:
        """The trunk's surface [R, C, 3] in the body's frame, from the neck down; the chest is at the middle column."""
        height = np.linspace(TRUNK[-1, 0], TRUNK[0, 0], 15)
        deep, wide, ahead = (np.interp(height, TRUNK[:, 0], TRUNK[:, column])[:, None] for column in (1, 2, 3))
        # between an ellipse and a box: a chest is flat
        c, s = -np.cos(AROUND), -np.sin(AROUND)
        x, y = np.sign(c) * np.abs(c) ** 0.85, np.sign(s) * np.abs(s) ** 0.85
        ring = np.stack([ahead + deep * x, wide * y, np.broadcast_to(height[:, None], (15, 23))], axis=2)
        ring[:, -1] = ring[:, 0]
        return self._on_trunk(ring)

    def _on_trunk(self, point: np.ndarray) -> np.ndarray:
        """Points above the hips, twisted with the height and leaning a little ahead; [..., 3]."""
        angle = self.twist * np.clip(point[..., 2] / 0.5, 0, 1)
        c, s = np.cos(angle), np.sin(angle)
        x, y, z = point[..., 0], point[..., 1], point[..., 2]
        lean = 0.05 * self.pose.gait * z
        return np.stack([c * x - s * y + lean, s * x + c * y, z + self.hips], axis=-1)

    def _limb(self, start: np.ndarray, end: np.ndarray, radii: tuple[float, float], look: Look) -> None:
        size = self.clothes.height
        self.parts.cone(self.owner, self.world(start), self.world(end), (size * radii[0], size * radii[1]), look)

    def _ellipsoid(
        self, centre: np.ndarray, radii: tuple[float, float, float], look: Look, turn: np.ndarray | None = None
    ) -> None:
        axes = self.turn if turn is None else self.turn @ turn
        self.parts.ellipsoid(self.owner, self.world(centre), self.clothes.height * np.array(radii), look, axes)


def _towards(first: np.ndarray, second: np.ndarray, share: float) -> np.ndarray:
    between: np.ndarray = first + share * (second - first)
    return between
