"""Systems of chapter 2 of the book, in its order."""

SYSTEMS = (
    "rotating_body_on_frame",
    "disk_on_shaft",
    "physical_pendulum_three_origins",
    "lamina_two_forces",
    "lamina_two_forces_fixed_direction",
    "lamina_double_pendulum",
    "lamina_on_parabola",
    "rotating_slender_rod",
    "two_link_robot_arm",
    "two_link_robot_arm_inverse",
    "carnival_ride",
    "pendulum_bob_energy",
)
