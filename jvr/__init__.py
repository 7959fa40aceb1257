"""A differentiable direct volume renderer in JAX."""
