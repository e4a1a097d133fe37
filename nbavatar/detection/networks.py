"""The four networks, run by OpenCV."""

from collections.abc import Callable, Mapping

import numpy as np

from nbavatar.detection.anchors import Detections, anchor_centres, decode
from nbavatar.detection.squares import Square, cut_square, to_image
from nbavatar.errors import DependencyError, require

__all__ = ["Landmarker", "Network", "Searcher"]


class Network:
    """One network in TensorFlow Lite's format.

    Raises:
        DependencyError: this build of OpenCV cannot read it.
    """

    def __init__(self, content: bytes, name: str) -> None:
        cv2 = require("cv2", "opencv-contrib-python-headless", "running the detectors")
        try:
            self._net = cv2.dnn.readNetFromTFLite(np.frombuffer(content, dtype=np.uint8))
        except (cv2.error, AttributeError) as error:
            reason = " ".join(str(error).split())[:160]
            raise DependencyError(
                f"OpenCV {cv2.__version__} cannot read the network {name} ({reason}); "
                "opencv-contrib-python-headless 4.10 or newer can"
            ) from error

    def show(self, image: np.ndarray, low: float) -> None:
        """Sets the input: uint8 `[S, S, 3]`, whose values become `low` (for 0) to 1 (for 255)."""
        planes = image.astype(np.float32).transpose(2, 0, 1)[None] / 255
        self._net.setInput(np.ascontiguousarray(low + (1 - low) * planes))

    def output(self, name: str) -> np.ndarray:
        """One output, float32. Outputs are asked for one by one: OpenCV 5.0 refuses a list of names."""
        return self._net.forward(name)


class Searcher:
    """A detector of boxes with key points.

    Args:
        content: of the file.
        name: of the network, for errors.
        size: side of the input [px].
        strides: of its layers.
        low: value that black has at the input.
        outputs: names of the boxes' and of the scores' output.
    """

    def __init__(
        self, content: bytes, name: str, size: int, strides: tuple[int, ...], low: float, outputs: tuple[str, str]
    ) -> None:
        self._net, self._size, self._low, self._outputs = Network(content, name), size, low, outputs
        self._anchors = anchor_centres(size, strides)

    def search(self, image: np.ndarray, window: Square, least: float) -> Detections:
        """Candidates in an upright square of the image.

        Args:
            image: uint8 `[H, W, 3]` RGB.
            window: where to look, not turned.
            least: score from which a candidate counts.

        Returns:
            in pixels of the image, doubles included.
        """
        self._net.show(cut_square(image, window, self._size), self._low)
        values, logits = (self._net.output(name) for name in self._outputs)
        count = len(self._anchors)
        found = decode(values.reshape(count, -1), logits.reshape(count), self._anchors, self._size, least)
        corners = to_image(found.boxes.reshape(-1, 2, 2), window, self._size).reshape(-1, 4)
        return Detections(corners, to_image(found.points, window, self._size), found.scores)


class Landmarker:
    """A network that places points in a crop.

    Args:
        content: of the file.
        name: of the network, for errors.
        size: side of the input [px].
        outputs: what is asked for -> name of the output; `points` and `score` at least.
        logits: whether the score is a logit.
    """

    def __init__(self, content: bytes, name: str, size: int, outputs: Mapping[str, str], *, logits: bool) -> None:
        self._net, self.size, self._outputs, self._logits = Network(content, name), size, dict(outputs), logits

    def show(self, image: np.ndarray, square: Square) -> None:
        """Sets the input: a square of an image uint8 `[H, W, 3]` RGB."""
        self._net.show(cut_square(image, square, self.size, replicate=True), 0.0)

    def score(self, image: np.ndarray, square: Square) -> float:
        """Shows the square to the network; how sure it is that there is what it looks for, in [0, 1]."""
        self.show(image, square)
        value = self.value("score")
        return float(1 / (1 + np.exp(-np.clip(value, -50.0, 50.0)))) if self._logits else value

    def place(
        self, image: np.ndarray, square: Square, again: Callable[[np.ndarray], Square], rounds: int
    ) -> tuple[Square, float]:
        """Shows a square, and then, in all `rounds` times, the one that `again` makes of the points found in it.

        Each output costs a pass through the network, so the early rounds are asked for nothing but the points.

        Returns:
            the square that was shown last, and its score.
        """
        for _ in range(rounds - 1):
            self.show(image, square)
            square = again(self.points(square))
        return square, self.score(image, square)

    def value(self, output: str) -> float:
        """A further number about the square that was shown last."""
        return float(self._net.output(self._outputs[output]).reshape(-1)[0])

    def points(self, square: Square) -> np.ndarray:
        """Points in the square that was shown last: float64 `[n, 3]`, x and y in the image [px], and depth [px]."""
        raw = self._net.output(self._outputs["points"]).reshape(-1, 3).astype(np.float64)
        depth = raw[:, 2:] * square.side / self.size
        return np.concatenate([to_image(raw[:, :2], square, self.size), depth], axis=1)
