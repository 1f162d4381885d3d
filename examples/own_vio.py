"""Visual-inertial odometry of a stereo camera and an IMU from scratch, step by step in docs/own_vio.md; needs OpenCV."""

import cv2
import numpy as np

import boxplus as bp
from boxplus.manifolds import quaternion, se3
from boxplus.residuals import ImuPreintegration, OnBody, Preintegration, Prior, Reprojection
from boxplus.simulation.cameras import as_camera_recording, make_rig, simulate_cameras

KEPT, CORNERS, PIXEL = 8, 100, 0.7  # frames in the window, corners followed, noise [px]


def follow(first, second, corners):
    """Corners (N, 2) of one image in another, and which of them come back to where they began."""
    there, ok, _ = cv2.calcOpticalFlowPyrLK(first, second, corners, None, winSize=(15, 15))
    back, ok_back, _ = cv2.calcOpticalFlowPyrLK(second, first, there, None, winSize=(15, 15))
    inside = ((there > 2) & (there < np.array(first.shape[::-1]) - 3.0)).all(axis=1)
    return there, (ok.ravel() == 1) & (ok_back.ravel() == 1) & inside & (np.linalg.norm(back - corners, axis=1) < 0.5)


# 1. The recording: stereo pairs, and all IMU samples.
simulation = simulate_cameras("room", 3, duration_s=6.0, rig=make_rig("stereo", None, 0.5, 12.0))
recording = as_camera_recording(simulation)
rig, noise = [camera.calibrated() for camera in recording.info.cameras], recording.info.imu.noise
events = list(recording)
images = [event for event in events if isinstance(event, bp.CameraImage)]
samples = [event for event in events if isinstance(event, bp.ImuSamples)]
time_ns, gyro, accel = (np.concatenate([getattr(s, name) for s in samples]) for name in ("time_ns", "gyro", "accel"))
pairs = [(a.time_ns, a.grey(), b.grey()) for a, b in zip(images[::2], images[1::2], strict=True) if a.time_ns < time_ns[-1]]

# 2. The first state, at rest: up is where the specific force points, and what the gyroscope reads is its bias.
rest = time_ns < pairs[0][0] + 1_000_000_000
up = accel[rest].mean(axis=0) / np.linalg.norm(accel[rest].mean(axis=0))
ahead = (np.array([1.0, 0.0, 0.0]) - up[0] * up) / np.sqrt(1.0 - up[0] ** 2)
pose = np.concatenate([quaternion.from_matrix(np.stack([ahead, np.cross(up, ahead), up])), np.zeros(3)])
state = np.concatenate([np.zeros(6), gyro[rest].mean(axis=0)])  # v, b_a, b_g

# 3. The problem: variables that come and go, mountings that are known, and what is known of the beginning.
problem = bp.Problem()
bodies = problem.add_variables(bp.BodyPose, pose, name="bodies")  # T_world_imu
states = problem.add_variables(bp.Euclidean(9), state, name="states")
points = problem.add_variables(bp.Euclidean(3), np.zeros((0, 3)), name="points")
mountings = np.array([[*quaternion.from_matrix(c.T_body_camera[:3, :3]), *c.T_body_camera[:3, 3]] for c in rig])
mounted = problem.add_variables(bp.BodyPose, mountings, name="mountings")
problem.fix(mounted)
problem.add_residuals(Prior(bp.BodyPose, pose, sigma=[0.02, 0.02, 1e-4, 1e-3, 1e-3, 1e-3]), bodies[0], name="beginning")
problem.add_residuals(Prior(bp.Euclidean(9), state, sigma=np.repeat([0.01, 0.1, 1e-3], 3)), states[0], name="rest")
corners, ids, views, path = np.zeros((0, 2), np.float32), np.zeros(0, dtype=int), {}, []

for k, (now_ns, left, right) in enumerate(pairs):
    if k:  # 4. Where the IMU says the body is now, and the residual that says so.
        b_a, b_g, span = states.values[-1, 3:6], states.values[-1, 6:], (pairs[k - 1][0], now_ns)
        imu = Preintegration.integrate(time_ns, gyro, accel, noise=noise, intervals_ns=span, bias_accel=b_a, bias_gyro=b_g)
        pose, state = imu.predict(bodies.values[-1], states.values[-1])
        problem.extend(bodies, pose)
        problem.extend(states, state)
        problem.add_residuals(ImuPreintegration(imu), bodies[[k - 1]], states[[k - 1]], bodies[[k]], states[[k]])
        # 5. Corners of the last image in this one; further down new ones, and all of them in the right image.
        corners, ok = follow(pairs[k - 1][1], left, corners)
        corners, ids = corners[ok], ids[ok]
    free = np.full(left.shape, 255, np.uint8)
    for corner in corners.astype(int).tolist():
        cv2.circle(free, corner, 15, 0, -1)
    new = cv2.goodFeaturesToTrack(left, max(CORNERS - len(corners), 1), 0.01, 15, mask=free)
    corners = np.vstack([corners, *([] if new is None else [new[:, 0]])])
    ids = np.concatenate([ids, np.full(len(corners) - len(ids), -1)])
    beside, ok = follow(left, right, corners)
    # 6. New points: where the rays of both cameras come closest, Σ (I − d dᵀ) (p − c) = 0.
    places = [se3.compose(bodies.values[-1], mounting) for mounting in mountings]
    seen_at = (corners, beside)
    d = [c.model.bearings(at)[0] @ quaternion.to_matrix(T[:4]).T for c, at, T in zip(rig, seen_at, places, strict=True)]
    across = [np.eye(3) - ray[:, :, None] * ray[:, None] for ray in d]
    A, b = sum(across) + 1e-9 * np.eye(3), sum(M @ T[4:] for M, T in zip(across, places, strict=True))
    p_world = np.linalg.solve(A, b[:, :, None])[..., 0]
    parallax, depth = np.linalg.norm(np.cross(*d), axis=1), ((p_world - places[0][4:]) * d[0]).sum(axis=1)
    fresh = ok & (ids < 0) & (parallax > 0.006) & (depth > 0.3)
    ids[fresh] = problem.extend(points, p_world[fresh]).ids
    # 7. What both cameras see of the points; the window solved.
    for c, known in enumerate((ids >= 0, (ids >= 0) & ok)):
        view = OnBody(Reprojection(rig[c].model, seen_at[c][known].astype(float), sigma=PIXEL))
        rows = bodies[np.full(known.sum(), k)], mounted[np.full(known.sum(), c)], points[ids[known]]
        views[k, c] = problem.add_residuals(view, *rows, loss=bp.losses.Cauchy(2.0)), ids[known]
    solution = problem.solve(max_iterations=6, cost_tolerance=1e-4, examine=False)
    problem.set_values(solution)
    path.append(bodies.values[-1].copy())
    # 8. The oldest frame leaves with the points that nobody follows any more; what it saw of the others is dropped.
    if k >= KEPT:
        gone = np.setdiff1d(points.ids, ids)
        for group, of in (views.pop((k - KEPT, c)) for c in range(2)):
            problem.remove(group[~np.isin(of, gone)])
        bp.marginalize(problem, [bodies[[k - KEPT]], states[[k - KEPT]], points[gone]], at=solution)

stamps, path = np.array([now_ns for now_ns, _, _ in pairs]), np.array(path)
motion = simulation.ground_truth(stamps)
truth = bp.Trajectory(stamps, motion.p_world_imu, quaternion.from_matrix(motion.R_world_imu))
error = bp.evaluate(bp.Trajectory(stamps, path[:, 4:], path[:, :4]), truth, alignment="yaw").ate.rmse
length = np.linalg.norm(np.diff(truth.p, axis=0), axis=1).sum()
print(f"{len(path)} frames, {points.next_id} points; position error {100 * error:.2f} cm (rms) over {length:.1f} m")
