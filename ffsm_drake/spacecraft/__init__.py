"""The spacecraft: coordinates, multibody plant, mass properties, and user-supplied URDFs."""
