"""The spacecraft: coordinates, the multibody plant, its mass properties, and URDFs from outside."""
