import cv2
import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from engine.posed import names
from engine.posed.classes import PALETTE
from engine.posed.names import matte_names, unique_names
from engine.scene import distinct_colour


def cielab(rgb: np.ndarray) -> np.ndarray:
    """CIELAB (D65) of sRGB bytes [N, 3], by OpenCV."""
    return cv2.cvtColor(np.float32(rgb).reshape(1, -1, 3) / 255, cv2.COLOR_RGB2LAB)[0].astype(np.float64)


def ciede2000(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    """The colour difference of CIE 142-2001 between CIELAB colours [..., 3] (Sharma, Wu, Dalal 2005)."""
    (light_1, a_1, b_1), (light_2, a_2, b_2) = (np.moveaxis(each, -1, 0) for each in np.broadcast_arrays(one, other))
    mean = ((np.hypot(a_1, b_1) + np.hypot(a_2, b_2)) / 2) ** 7
    stretch = 1.5 - 0.5 * np.sqrt(mean / (mean + 25.0**7))
    chroma_1, chroma_2 = np.hypot(stretch * a_1, b_1), np.hypot(stretch * a_2, b_2)
    hue_1, hue_2 = (np.degrees(np.arctan2(b, stretch * a)) % 360 for a, b in ((a_1, b_1), (a_2, b_2)))
    turn = (hue_2 - hue_1 + 180) % 360 - 180
    hue, chroma, light = hue_1 + turn / 2, (chroma_1 + chroma_2) / 2, (light_1 + light_2) / 2 - 50
    waves = ((-0.17, 1, -30.0), (0.24, 2, 0.0), (0.32, 3, 6.0), (-0.2, 4, -63.0))
    in_hue = 1 + sum(weight * np.cos(np.radians(times * hue + shift)) for weight, times, shift in waves)
    blue = np.exp(-(((hue % 360 - 275) / 25) ** 2))
    rotation = -2 * np.sqrt(chroma**7 / (chroma**7 + 25.0**7)) * np.sin(np.radians(60 * blue))
    lightness = (light_2 - light_1) / (1 + 0.015 * light**2 / np.sqrt(20 + light**2))
    saturation = (chroma_2 - chroma_1) / (1 + 0.045 * chroma)
    turned = 2 * np.sqrt(chroma_1 * chroma_2) * np.sin(np.radians(turn / 2)) / (1 + 0.015 * chroma * in_hue)
    return np.sqrt(lightness**2 + saturation**2 + turned**2 + rotation * saturation * turned)


def nearest_pair(colours: list[tuple[int, int, int]]) -> tuple[float, float]:
    """The smallest difference of two colours, by CIEDE2000 and as a distance in CIELAB."""
    lab = cielab(np.array(colours))
    one, other = np.triu_indices(len(lab), 1)
    return float(ciede2000(lab[one], lab[other]).min()), float(np.linalg.norm(lab[one] - lab[other], axis=1).min())


def test_any_two_of_40_class_colours_are_far_apart() -> None:
    """4 and 1.6 in CIELAB and by CIEDE2000 before there was a palette. 2.3 is a just noticeable distance in CIELAB."""
    for colours in (list(PALETTE[:40]), [distinct_colour(instance) for instance in range(1, 41)]):
        difference, distance = nearest_pair(colours)
        assert difference > 11 and distance > 11
    assert nearest_pair(list(PALETTE))[0] > 5


def test_instance_colours_differ_from_those_of_common_classes() -> None:
    of_classes, of_instances = PALETTE[:40], [distinct_colour(instance) for instance in range(1, 400)]
    assert len({*of_instances}) == len(of_instances) and not {*of_classes} & {*of_instances}
    assert distinct_colour(1) == distinct_colour(1 + len(PALETTE))


PARTS = st.sampled_from(
    ["chair", "Chair", "ch\N{LATIN SMALL LETTER SHARP S}", "chss", " #1", " #3", " #12", "_2", ",", " "]
)
NAMES = st.dictionaries(st.integers(1, 20), st.lists(PARTS, max_size=4).map("".join), max_size=12)


@given(NAMES, st.sampled_from([" #", "_"]), st.integers(2, 32))
@example({1: "chair", 2: "Chair", 3: "chair #1"}, " #", 32)
def test_matte_names_are_unique(given_names: dict[int, str], mark: str, bits: int) -> None:
    """The matte's number has so few bits here that names share it often."""
    with pytest.MonkeyPatch.context() as patch:
        exact = names.name_bits
        patch.setattr(names, "name_bits", lambda name: exact(name) % (1 << max(bits, 8)))
        unique = unique_names(given_names, mark)
        numbers = {names.name_bits(name) for name in unique.values()}
    assert [*unique] == [*given_names]
    assert len(numbers) == len({name.casefold() for name in unique.values()}) == len(given_names)
    assert all(unique[key].startswith(name) for key, name in given_names.items())
    folded = [name.casefold() for name in given_names.values()]
    if bits == 32:
        assert all(unique[key] == name for key, name in given_names.items() if folded.count(name.casefold()) == 1)


def test_matte_names_change_only_characters_that_must_change() -> None:
    given_names = {1: "chair 1", 2: 'a "b", c', 3: "Chair 1", 4: ",", 5: "T\u00fcr", 6: "Tu\u0308r", 7: "desk"}
    assert matte_names(given_names) == {
        1: "chair 1 #1", 2: "a b c", 3: "Chair 1 #3", 4: "id 4", 5: "T\u00fcr #5", 6: "Tu\u0308r #6", 7: "desk",
    }  # fmt: skip
