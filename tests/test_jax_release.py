"""The miscompilation of jax 0.10.2 on CPU (jax-ml/jax#39103), the reason why that release is excluded."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_a_vmapped_matrix_vector_product_then_a_reduction_is_right(dtype):
    rows = np.random.default_rng(1).normal(size=(40_000, 3)).astype(dtype)
    turn = np.asarray([[0, 1, 0], [0, 0, 1], [1, 0, 0]], dtype)
    energy = jax.jit(jax.vmap(lambda row: jnp.sum((turn @ row) ** 2)))(rows)
    np.testing.assert_allclose(energy, (rows.astype(float) ** 2).sum(axis=1), rtol=1e-5)
