"""A window of the ten newest frames and what they see; older ones leave a prior: `python examples/sliding_window.py`."""

import numpy as np

import boxplus as bp
from boxplus.manifolds import se3

FRAMES, WINDOW = 80, 10
rng = np.random.default_rng(0)
camera = bp.Pinhole(400.0, 400.0, 320.0, 240.0)
turn = np.linspace(0.0, 1.5 * np.pi, FRAMES)  # along the inside of a round wall of landmarks, looking outwards
T_world_camera = se3.compose(
    se3.exp(np.stack([0 * turn, turn, 0 * turn, 0 * turn, 0 * turn, 0 * turn], 1)), [1.0, 0, 0, 0, 0, 0, 3.0]
)
T_true = se3.inverse(T_world_camera)  # T_camera_world
angle = rng.uniform(0.0, 2.0 * np.pi, 900)
landmarks = np.column_stack([9.0 * np.sin(angle), rng.uniform(-3.0, 3.0, 900), 9.0 * np.cos(angle)])
sigma = np.repeat([0.005, 0.02], 3)  # of the odometry between two frames [rad, m]

problem = bp.Problem()
frames = problem.add_variables(bp.SE3Left, T_true[:1], name="frames")
points = problem.add_variables(bp.Euclidean(3), np.zeros((0, 3)), name="points")
problem.add_residuals(bp.residuals.Prior(bp.SE3Left, T_true[0], sigma=0.001), frames[0], name="beginning")
gauge = bp.world_gauge({frames: "body_from_world", points: "point"})
id_of: dict[int, int] = {}  # landmark → its id among the points
views, seen_by = {}, {}
odometry_alone = T_true[0]
leaks = []

for k in range(FRAMES):
    if k:
        step = se3.compose(T_true[k], se3.inverse(T_true[k - 1]))
        odometry = bp.SE3Left.boxplus(step, sigma * rng.normal(size=6))
        odometry_alone = se3.compose(odometry, odometry_alone)
        problem.extend(frames, se3.compose(odometry, frames.values[-1]))
    pixels, ahead = camera.project(se3.act(T_true[k], landmarks))
    seen = np.flatnonzero(ahead & (np.abs(pixels - [320.0, 240.0]) < [320.0, 240.0]).all(axis=1))
    fresh = [int(n) for n in seen if n not in id_of]
    if fresh:
        start = landmarks[fresh] + 0.2 * rng.normal(size=(len(fresh), 3))
        id_of |= dict(zip(fresh, problem.extend(points, start).ids.tolist(), strict=True))
    measured = pixels[seen] + rng.normal(size=(len(seen), 2))
    seen_by[k], numbers = seen, [id_of[int(n)] for n in seen]
    view = bp.residuals.Reprojection(camera, measured)
    views[k] = problem.add_residuals(view, frames[k], points[numbers], loss=bp.losses.Huber(1.5), name=f"view {k}")
    solution = problem.solve(max_iterations=5, cost_tolerance=1e-4)
    problem.set_values(solution)
    if k >= WINDOW:
        oldest = k - WINDOW
        lost = sorted(set(id_of) - set(seen.tolist()))
        # What the oldest frame saw of landmarks that stay is dropped: the prior then knows frames only.
        problem.remove(views[oldest][~np.isin(seen_by[oldest], lost)])
        leaving = [frames[oldest], points[[id_of.pop(n) for n in lost]]]
        leaks.append(bp.marginalize(problem, leaving, at=solution, gauge=gauge).leak)

error = bp.SE3Left.boxminus(frames.values[-1], T_true[-1])
print(f"{len(frames)} frames and {len(points)} points are left of {frames.next_id} and {points.next_id}")
print(f"odometry alone is off by {np.linalg.norm(bp.SE3Left.boxminus(odometry_alone, T_true[-1])[3:]):.3f} m")
print(f"the window is off by {np.linalg.norm(error[3:]):.3f} m")
print("the beginning was known, so the prior may know where the world is:", leaks[-1].sentences()[0])
