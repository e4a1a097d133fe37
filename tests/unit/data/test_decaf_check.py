import numpy as np
import pytest

from nbavatar.camera.distortion import distort_pixels
from nbavatar.camera.pinhole import project
from nbavatar.checks import decaf as decaf_check
from nbavatar.checks.decaf import check_subject
from nbavatar.data.decaf_files import find_subject


@pytest.mark.parametrize(("shift", "lens"), [(0.0, True), (0.5, True), (0.0, False)])
def test_reprojection_tells_the_lens_and_the_pixel_centre(decaf, shift, lens):
    """Landmarks are overwritten by exact ones: under the lens or not, and with another pixel centre."""
    subject = find_subject(decaf, "S2")
    report = check_subject(subject, ["100"])
    camera = report.cameras["100"]
    for part, points in decaf_check._landmarks(subject, report.sequence).items():
        pixels, _ = project(points, camera.K, camera.cam_from_world)
        seen = distort_pixels(pixels, camera.K, camera.distortion if lens else None) - shift
        np.save(subject.keypoints(part, "100"), np.concatenate([seen, np.ones_like(seen[..., :1])], -1))
    again = check_subject(subject, ["100"])
    assert not again.defects and {r.part for r in again.reprojection} == {"head", "right_hand"}
    for r in again.reprojection:
        if lens:
            np.testing.assert_allclose(r.offset, -shift, atol=1e-3)
            assert r.with_lens == pytest.approx(shift * np.sqrt(2), abs=1e-3)
        else:
            assert r.without_lens < 1e-3 < r.with_lens


def test_defects_are_collected_over_cameras(decaf):
    subject = find_subject(decaf, "S2")
    subject.video("100").unlink()
    report = check_subject(subject, ["084", "100"])
    assert len(report.defects) == 1 and "100.mp4" in report.defects[0] and report.sequence is not None
