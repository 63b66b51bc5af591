"""Weights on the wire: exact in float32, close in float16, refused when damaged."""

from __future__ import annotations

from dataclasses import replace

import msgpack
import numpy as np
import pytest
import xxhash

from common.bulk_payload import Seal
from common.codec import decode, encode
from common.errors import MessageError
from common.messages import PolicyWeights
from common.policies import policy_from_weights
from common.policies.weights import (
    encode_weights,
    initial_parameters,
    pack_weights,
    parameter_layout,
    parameter_shapes,
    prepare_encoding,
    unpack_weights,
)
from tests.reference.tasks import make_spec

SPEC = make_spec((32, 36, 3))
STRIDES = (2, 2, 1, 1)
LAYOUT = parameter_layout(SPEC, 16, STRIDES)
SHAPES = LAYOUT.by_name


def make_parameters():
    return initial_parameters(SPEC, 16, STRIDES, np.random.default_rng(0))


def make_weights(parameters=None, dtype="float32"):
    return pack_weights(
        make_parameters() if parameters is None else parameters,
        version=3,
        updates=150,
        algorithm="sac",
        hidden_size=16,
        encoder_strides=STRIDES,
        dtype=dtype,
    )


def with_buffer(weights, values):
    """Return the weights with another buffer and a digest that fits it."""
    buffer = np.frombuffer(values.tobytes(), np.uint8)
    return replace(weights, buffer=buffer, digest=xxhash.xxh3_128_hexdigest(buffer.tobytes()))


def test_shapes_are_those_of_the_thesis():
    # 9 channels of three RGB frames; 64 features + 3 proprioception + 2 previous action; mean and log std of 2.
    assert SHAPES["encoder.0.weight"] == [32, 9, 3, 3]
    assert SHAPES["actor.0.weight"] == [16, 69]
    assert SHAPES["actor.2.weight"] == [4, 16]
    assert "encoder.0.weight" not in parameter_shapes(make_spec(), 16, STRIDES)


def test_only_the_head_differs_between_zero_and_default_initialisation():
    zero = make_parameters()
    default = initial_parameters(SPEC, 16, STRIDES, np.random.default_rng(0), zero_initialised_head=False)
    assert list(default) == list(zero)
    head = ("actor.2.weight", "actor.2.bias")
    for name in zero.keys() - set(head):
        np.testing.assert_array_equal(default[name], zero[name], err_msg=name)
    for name in head:
        assert not zero[name].any()
        # torch.nn.Linear: uniform in +-1 / sqrt(16).
        assert 0.15 < np.abs(default[name]).max() <= 0.25
        assert len(np.unique(default[name])) == default[name].size


def test_float32_arrives_to_the_last_bit_through_the_codec():
    parameters = make_parameters()
    arrived = unpack_weights(decode(encode(make_weights()), PolicyWeights), LAYOUT)
    assert list(arrived) == list(parameters)
    for name, values in parameters.items():
        np.testing.assert_array_equal(arrived[name], values)


def test_float16_halves_the_bytes_and_keeps_values_close():
    parameters, weights = make_parameters(), make_weights(dtype="float16")
    assert weights.buffer.nbytes * 2 == make_weights().buffer.nbytes
    for name, values in unpack_weights(weights, LAYOUT).items():
        assert values.dtype == np.float32
        np.testing.assert_allclose(values, parameters[name], rtol=2**-11, atol=1e-7)


def test_a_changed_byte_is_refused_by_the_digest():
    weights = make_weights()
    buffer = weights.buffer.copy()
    buffer[1000] ^= 1
    with pytest.raises(MessageError, match="digest"):
        unpack_weights(replace(weights, buffer=buffer), LAYOUT)


def test_weights_of_another_network_are_refused_naming_what_differs():
    with pytest.raises(MessageError, match=r"actor.0.bias.*\[32\].*\[16\]"):
        unpack_weights(make_weights(), parameter_layout(SPEC, 32, STRIDES))
    with pytest.raises(MessageError, match="encoder"):
        policy_from_weights(make_spec(), make_weights())


def test_a_buffer_of_the_wrong_length_is_refused():
    weights = make_weights()
    values = weights.buffer.view(np.float32)[:-1]
    with pytest.raises(MessageError, match="bytes"):
        unpack_weights(with_buffer(weights, values), LAYOUT)


def test_a_network_larger_than_any_memory_is_refused_by_its_bytes():
    huge = parameter_layout(SPEC, 2**40, STRIDES)
    weights = replace(make_weights(), names=huge.names, shapes=huge.shapes, hidden_size=2**40)
    with pytest.raises(MessageError, match=f"expected {4 * huge.size} bytes"):
        policy_from_weights(SPEC, weights)


def test_the_arrays_are_views_of_the_buffer():
    weights = make_weights()
    for values in unpack_weights(weights, LAYOUT).values():
        assert np.shares_memory(values, weights.buffer)
        assert not values.flags.writeable


@pytest.mark.parametrize("at", [0, 5000, -1])
def test_a_changed_bit_is_refused_wherever_it_is(at):
    weights = make_weights()
    buffer = weights.buffer.copy()
    buffer[at] ^= 1
    with pytest.raises(MessageError, match=f"expected digest {weights.digest}, got"):
        unpack_weights(replace(weights, buffer=buffer), LAYOUT)


@pytest.mark.parametrize("bits", [0x7F800000, 0xFF800000, 0x7FC00000, 0xFFC00001], ids=["inf", "-inf", "nan", "-nan"])
@pytest.mark.parametrize("at", [0, 7, -1])
def test_a_number_that_is_not_finite_is_refused_although_its_digest_fits(bits, at):
    weights = make_weights()
    values = np.frombuffer(weights.buffer.tobytes(), np.uint32).copy()
    values[at] = bits
    with pytest.raises(MessageError, match="finite"):
        unpack_weights(with_buffer(weights, values), LAYOUT)


def test_finite_numbers_whose_squares_are_not_are_accepted():
    parameters = make_parameters()
    parameters["actor.1.bias"][0] = 3e38
    assert unpack_weights(make_weights(parameters), LAYOUT)["actor.1.bias"][0] == np.float32(3e38)


def test_the_message_is_a_copy_of_the_parameters():
    parameters = make_parameters()
    weights = make_weights(parameters)
    before = weights.buffer.copy()
    for values in parameters.values():
        values += 1.0  # as a learner goes on
    np.testing.assert_array_equal(weights.buffer, before)


def wide_parameters():
    """A policy with layers large enough to be copied and taken in at once, not all of them in one piece of memory."""
    parameters = initial_parameters(SPEC, 200, STRIDES, np.random.default_rng(0), zero_initialised_head=False)
    parameters["actor.1.weight"] = np.asfortranarray(parameters["actor.1.weight"])
    parameters["actor.0.bias"] = np.repeat(parameters["actor.0.bias"], 2)[::2]
    return parameters


def encode_wide(parameters, **changes):
    arguments = {"version": 3, "updates": 150, "algorithm": "sac", "hidden_size": 200, "encoder_strides": STRIDES}
    return encode_weights(parameters, **(arguments | {"dtype": "float32"} | changes))


def test_the_digest_taken_while_copying_is_in_the_payload_that_any_encoder_would_make():
    parameters = wide_parameters()
    values = b"".join(values.tobytes() for values in parameters.values())
    weights = PolicyWeights(
        version=3,
        updates=150,
        algorithm="sac",
        hidden_size=200,
        encoder_strides=np.array(STRIDES, np.int64),
        names=list(parameters),
        shapes=[list(values.shape) for values in parameters.values()],
        dtype="float32",
        buffer=np.frombuffer(values, np.uint8),
        digest=xxhash.xxh3_128_hexdigest(values),
    )
    assert decode(encode_wide(parameters), PolicyWeights).digest == weights.digest
    assert msgpack.unpackb(encode_wide(parameters)) == msgpack.unpackb(encode(weights))
    assert policy_from_weights(SPEC, decode(encode_wide(parameters), PolicyWeights, SPEC.dimensions)).version == 3


def test_a_number_that_is_not_finite_is_sent_with_a_digest_that_fits_and_refused_by_the_receiver():
    parameters = wide_parameters()
    parameters["actor.1.weight"][7, 8] = np.nan
    with pytest.raises(MessageError, match="expected finite numbers"):
        policy_from_weights(SPEC, decode(encode_wide(parameters), PolicyWeights))


@pytest.mark.parametrize("changes", [{"encoder_strides": ()}, {"dtype": "float16"}])
def test_nothing_is_compiled_for_policies_without_camera_or_in_half_precision(changes, monkeypatch):
    monkeypatch.setattr("common.policies.weights._SEAL", Seal("digest", None))
    monkeypatch.setattr("common.policies.weights.compile_take_in_and_copy", None)
    prepare_encoding(changes.get("encoder_strides", STRIDES), changes.get("dtype", "float32"))
    weights = decode(encode_wide(wide_parameters(), **changes), PolicyWeights)
    assert weights.digest == xxhash.xxh3_128_hexdigest(weights.buffer.tobytes())


def test_parameters_may_come_in_another_order():
    parameters = make_parameters()
    turned = dict(reversed(parameters.items()))
    arrived = unpack_weights(make_weights(turned), LAYOUT)
    assert list(arrived) == list(turned)
    for name, values in parameters.items():
        np.testing.assert_array_equal(arrived[name], values)


def test_names_that_come_twice_or_without_shapes_are_refused():
    weights = make_weights()
    twice = replace(weights, names=[*weights.names, "actor.0.bias"], shapes=[*weights.shapes, [16]])
    for changed in (twice, replace(weights, names=[*weights.names, "x"]), replace(weights, shapes=weights.shapes[:-1])):
        with pytest.raises(MessageError, match="another network"):
            unpack_weights(changed, LAYOUT)


@pytest.mark.parametrize("dtype", ["float32", "float16"])
def test_the_values_begin_at_a_multiple_of_four_bytes_however_long_the_other_fields_are(dtype):
    for length in range(8):
        weights = pack_weights(
            make_parameters(),
            version=3,
            updates=150,
            algorithm="x" * length,
            hidden_size=16,
            encoder_strides=STRIDES,
            dtype=dtype,
        )
        assert weights.buffer.ctypes.data % 4 == 0
        assert not weights.buffer.flags.owndata
        unpack_weights(weights, LAYOUT)


def test_weights_are_read_wherever_their_bytes_begin():
    weights = make_weights()
    for offset in range(1, 4):
        shifted = np.zeros(weights.buffer.size + offset, np.uint8)[offset:]
        shifted[:] = weights.buffer
        for name, values in unpack_weights(replace(weights, buffer=shifted), LAYOUT).items():
            assert values.flags.aligned
            np.testing.assert_array_equal(values, make_parameters()[name])


def test_a_value_too_large_for_float16_is_refused_by_the_sender():
    parameters = make_parameters()
    parameters["actor.1.bias"][0] = 1e6
    with pytest.raises(MessageError, match="float16"):
        make_weights(parameters, dtype="float16")


def test_an_unknown_number_format_is_refused():
    with pytest.raises(MessageError, match="bfloat16"):
        unpack_weights(replace(make_weights(), dtype="bfloat16"), LAYOUT)


@pytest.mark.parametrize("strides", [[], [2, 2, 0, 1], [2, 2, 2, 2, 2, 2]])
def test_strides_that_do_not_fit_the_task_are_refused(strides):
    with pytest.raises(MessageError):
        policy_from_weights(SPEC, replace(make_weights(), encoder_strides=np.array(strides, np.int64)))
