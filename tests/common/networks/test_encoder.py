"""Spatial softmax by hand; the encoder's input scaling, layouts and number formats."""

from __future__ import annotations

import pytest
import torch
from torch.nn import functional

from common.errors import ConfigError
from common.networks.encoder import Encoder, map_positions, spatial_softmax


def make_encoder(height=32, width=40, wide=torch.float32, dtype=torch.float32):
    torch.manual_seed(0)
    return Encoder(height, width, 9, (2, 2, 1, 1), dtype=dtype, wide=wide)


def random_frames(batch_size=3, height=32, width=40):
    generator = torch.Generator().manual_seed(1)
    return torch.randint(0, 256, (batch_size, height, width, 9), dtype=torch.uint8, generator=generator)


def test_expected_positions_by_hand():
    # Probabilities 1/2 at (x -1, y -1), 1/4 at (0, -1), 1/4 at (1, 1); a 2x3 map, x to the right, y downwards.
    maps = torch.full((1, 1, 2, 3), -1e9)
    maps[0, 0, 0, 0], maps[0, 0, 0, 1], maps[0, 0, 1, 2] = 2.0**0.5, 0.0, 0.0
    maps[0, 0, 0, 0] = torch.log(torch.tensor(2.0))
    features = spatial_softmax(maps, map_positions(2, 3).float())
    torch.testing.assert_close(features, torch.tensor([[-0.5 + 0.25, -0.75 + 0.25]]))


def test_features_are_pairs_of_x_and_y_per_channel():
    maps = torch.full((1, 2, 3, 3), -1e9)
    maps[0, 0, 0, 2] = 0.0  # channel 0: top right
    maps[0, 1, 2, 0] = 0.0  # channel 1: bottom left
    features = spatial_softmax(maps, map_positions(3, 3).float())
    torch.testing.assert_close(features, torch.tensor([[1.0, -1.0, -1.0, 1.0]]))


def test_a_constant_map_is_at_the_centre_and_a_shift_changes_nothing():
    positions = map_positions(4, 5).float()
    torch.testing.assert_close(spatial_softmax(torch.full((2, 1, 4, 5), 7.0), positions), torch.zeros(2, 2))
    maps = torch.randn(2, 3, 4, 5, generator=torch.Generator().manual_seed(0))
    torch.testing.assert_close(spatial_softmax(maps + 3.0, positions), spatial_softmax(maps, positions))


def test_a_single_row_or_column_is_at_the_centre():
    assert map_positions(1, 3).tolist() == [[-1.0, 0.0], [0.0, 0.0], [1.0, 0.0]]


def test_pixels_enter_as_zero_to_one_in_the_frames_channel_order():
    encoder, frames = make_encoder(dtype=torch.float64, wide=torch.float64), random_frames()
    maps = frames.permute(0, 3, 1, 2).double().contiguous() / 255
    for i, (convolution, stride) in enumerate(zip(encoder, (2, 2, 1, 1), strict=True)):
        maps = functional.conv2d(maps, convolution.weight, convolution.bias, stride)
        maps = maps.relu() if i < 3 else maps
    expected = spatial_softmax(maps, map_positions(*maps.shape[2:]))
    torch.testing.assert_close(encoder(frames), expected)


def test_features_are_64_positions():
    features = make_encoder()(random_frames())
    assert features.shape == (3, 64)
    assert features.abs().max() <= 1.0


def test_bfloat16_convolutions_keep_float32_features_close():
    full, half = make_encoder(), make_encoder(wide=torch.bfloat16)
    features = half(random_frames())
    assert features.dtype == torch.float32
    torch.testing.assert_close(features, full(random_frames()), atol=2e-3, rtol=0.0)


def test_frames_too_small_for_the_strides_are_refused_with_their_size():
    with pytest.raises(ConfigError, match="16x40"):
        make_encoder(height=16)
