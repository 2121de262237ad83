"""Encoders of the broadcast streams: bytes in, bytes out, with a stated error bound. No sockets, no clocks, no MuJoCo.

`rigid` (poses of rigid bodies), `quantise` (the number formats it uses), `deformable` (vertices of deformable meshes),
`deformable_topology` (their order and prediction), `cloud` (points with colours), `errors`.
"""
