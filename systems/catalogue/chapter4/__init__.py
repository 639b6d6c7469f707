"""Systems of chapter 4 of the book, in its order."""

SYSTEMS = (
    "rigid_body_roll_pitch_yaw",
    "tricycle",
    "tricycle_book_lagrangian",
    "body_axis_translation",
    "euler_rotational_equations",
    "rigid_aircraft",
    "quadcopter_body_axes",
)
