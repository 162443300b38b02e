"""User-supplied models: reading a URDF (or another format as one), and writing a copy for Drake.

URDFs contain elements of no use for a free-flying spacecraft in Drake: settings of controllers and
simulators, collision shapes, friction, missing meshes. The copy omits these and lists them. A gap
to be filled by the author, such as a missing mass, is an error with its remedy.
"""
