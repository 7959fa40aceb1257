"""Ray marching: how rays become radiance, a whole batch at a time, and the derivatives of that."""
