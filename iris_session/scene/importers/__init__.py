"""Readers of geometry files: glTF and GLB, OBJ, STL, PLY, OFF, DAE, and URDF robots.

`files.load_file` reads any mesh file into nodes, `urdf.read_urdf` a robot into an articulation and drawn items. Both
check sizes, counts and paths before a library sees untrusted bytes. Not here: MuJoCo models (`mujoco_scene`), and how
nodes become a scene (`builder`, `build`).
"""
