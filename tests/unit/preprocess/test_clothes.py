import numpy as np

from nbavatar.preprocess.clothes import ClothesModel


def picture(rng):
    """Skin above, a red collar below it that covers part of the neck, and the torso of the same cloth."""
    image = np.zeros((120, 100, 3))
    image[:70] = (200, 160, 130)
    image[60:70, 30:60] = (150, 40, 50)
    image[70:] = (150, 40, 50)
    shade = np.linspace(0.6, 1.0, 100)[:, None]
    return (image * shade + rng.normal(0, 4, image.shape)).clip(0, 255).astype(np.uint8)


def regions():
    head, neck, torso = (np.zeros((120, 100), bool) for _ in range(3))
    head[:50], neck[50:70], torso[75:] = True, True, True
    return head, neck, torso


def test_cloth_in_the_neck_is_found_and_skin_is_kept():
    rng = np.random.default_rng(0)
    head, neck, torso = regions()
    model = ClothesModel(1.0)
    image = picture(rng)
    model.learn(image, head, torso)
    cloth = model.cloth(image, neck)
    assert not (cloth & ~neck).any()
    truth = np.zeros_like(neck)
    truth[60:70, 30:60] = True
    assert (cloth & truth).sum() / (cloth | truth).sum() > 0.9


def test_a_torso_of_the_head_s_colours_changes_nothing():
    rng = np.random.default_rng(1)
    head, neck, torso = regions()
    image = (np.array([200, 160, 130]) + rng.normal(0, 12, (120, 100, 3))).clip(0, 255).astype(np.uint8)
    model = ClothesModel(1.0)
    model.learn(image, head, torso)
    assert not model.cloth(image, neck).any()


def test_nothing_is_judged_before_enough_was_seen():
    head, neck, torso = regions()
    image = picture(np.random.default_rng(2))
    model = ClothesModel(1.0)
    assert not model.cloth(image, neck).any()
    model.learn(image, head, torso & False)
    assert not model.cloth(image, neck).any()
    assert not ClothesModel(1.0).cloth(image, neck & False).any()
