"""`jvr` beside other volume renderers: the same scene, camera, transfer function and two threads, in one run.

`python -m benchmarks peers [--quick] [--json FILE]`; docs/peers.md says what is compared.
"""
