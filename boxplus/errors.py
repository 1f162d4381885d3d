"""The errors boxplus raises, all with messages of one form: what was expected – what came – what to do."""

from __future__ import annotations

_UNSEEN = [*range(9), *range(11, 32), *range(127, 160), *range(0x202A, 0x202F), *range(0x2066, 0x206A)]
_AS_TEXT = {code: f"\\x{code:02x}" if code < 256 else f"\\u{code:04x}" for code in _UNSEEN}


def printable(text: str) -> str:
    """`text` with what steers a terminal written out: names in files may hold escape sequences that hide or fake output.

    These are control characters, tabs and line ends aside, and what turns the direction of writing.

    Example:
        >>> printable("/lidar\\x1b[2K")
        '/lidar\\\\x1b[2K'
    """
    return text.translate(_AS_TEXT)


class BoxplusError(Exception):
    """Base of every error raised on purpose by boxplus.

    Example:
        >>> try:
        ...     bp.read_trajectory("nowhere.tum")
        ... except bp.BoxplusError as error:  # whatever boxplus refuses
        ...     print(type(error).__name__)
        InputError
    """

    def __init__(self, message: str) -> None:
        super().__init__(printable(message))


class InputError(BoxplusError, ValueError):
    """An argument, a configuration value or a file does not have the form that was asked for.

    The message reads `expected … – got … – do …`.

    Example:
        >>> try:
        ...     bp.Pinhole(fx=-500.0, fy=500.0, cx=320.0, cy=240.0)
        ... except bp.InputError as error:
        ...     print(error)
        expected fx positive and finite [px] – got -500.0 – a camera that looks along −z: turn its frame first
    """

    def __init__(self, expected: str, got: str, advice: str) -> None:
        super().__init__(f"expected {expected} – got {got} – {advice}")
        self.expected = expected
        self.got = got
        self.advice = advice


class RecordingError(InputError):
    """A recording cannot be read: missing topic, unknown layout, corrupt or truncated file.

    Example:
        >>> try:
        ...     bp.open_recording("nowhere.bag")
        ... except bp.RecordingError as error:
        ...     print(error)
        expected a recording – got no file or folder nowhere.bag – check the path
    """


class AmbiguityError(RecordingError):
    """The data fits two readings (of a unit, a time base, a topic); the message says which option decides.

    Example:
        >>> print(bp.AmbiguityError("one LiDAR topic", "several: /front, /rear", "choose one with --lidar-topic"))
        expected one LiDAR topic – got several: /front, /rear – choose one with --lidar-topic
    """


class NotFiniteError(InputError):
    """A residual or a Jacobian is NaN or infinite; the message names the group, the residual and its variables.

    Example:
        >>> problem = bp.Problem()
        >>> x = problem.add_variables(bp.Euclidean(1), [0.0], name="x")
        >>> line = bp.Euclidean(1)
        >>> root = bp.residuals.UserResidual(lambda x: np.sqrt(x - 1.0), dim=1, manifolds=(line,), count=1, is_batch=True)
        >>> group = problem.add_residuals(root, x, name="root")
        >>> with np.errstate(invalid="ignore"):
        ...     try:
        ...         problem.solve()
        ...     except bp.NotFiniteError as error:
        ...         print("root" in str(error))
        True
    """


class SingularProblemError(BoxplusError):
    """A least-squares problem does not determine its variables; the message says which, along which directions, and why.

    Example:
        >>> problem = bp.Problem()
        >>> poses = problem.add_variables(bp.SE2, [[0.0, 0.0, 0.0], [0.0, 0.8, 0.0]], name="poses")
        >>> edges = problem.add_residuals(bp.residuals.RelativePose2D([0.0, 1.0, 0.0], sigma=0.1), poses[0], poses[1])
        >>> try:
        ...     solution = problem.solve(method="gauss_newton")
        ... except bp.SingularProblemError as error:  # nothing says where the poses are
        ...     print("poses[0, 1]" in str(error))
        True
    """


class OutputError(BoxplusError, OSError):
    """A result could not be written: full disk, unwritable folder.

    Example:
        >>> graph = bp.read_pose_graph("loops.g2o")
        >>> try:
        ...     bp.formats.write_g2o("no_such_folder/loops.g2o", graph)
        ... except bp.OutputError as error:
        ...     print("no_such_folder" in str(error))
        True
    """
