"""Array shapes that signatures share; see jaxtyping for the notation."""

from jaxtyping import Array, Float

Scalar = Float[Array, ""]
Twist = Float[Array, "6"]
Wrench = Float[Array, "6"]
Pose = Float[Array, "4 4"]
