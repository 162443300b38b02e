"""User-supplied models: reading a URDF (or another format as a URDF), and writing a copy for Drake.

URDFs contain elements without use for a free-flying spacecraft in Drake: settings of controllers
and simulators, collision shapes, friction, missing meshes. The copy omits these elements and lists
them. If the author must add something, such as a mass, an error names the remedy.
"""
