"""The attitude that follows from a gyroscope alone."""

import numpy as np
from scipy.spatial.transform import Rotation

from boxplus.sensors.inertial.gyro_attitude import GyroAttitude


def test_attitude_is_the_integral_of_the_rate() -> None:
    def attitude(time_s: np.ndarray) -> Rotation:
        phase = np.outer(time_s, [2.1, 2.7, 1.7]) + np.array([0.0, 1.0, 2.0])
        return Rotation.from_rotvec(np.array([0.5, 0.4, 0.6]) * np.sin(phase))

    time = np.arange(800) / 200
    gyro = (attitude(time - 1e-4).inv() * attitude(time + 1e-4)).as_rotvec() / 2e-4
    integrated = GyroAttitude(np.rint(time * 1e9).astype(np.int64), gyro)
    asked = np.linspace(0.0, 3.9, 40)
    R = integrated.at(np.rint(asked * 1e9).astype(np.int64))
    np.testing.assert_allclose(R, (attitude(np.zeros(40)).inv() * attitude(asked)).as_matrix(), atol=1e-4)
    assert integrated.covers(np.array([0, 4_000_000_000]), 0.0).tolist() == [True, False]
