"""Classics of linked, nonholonomic and rigid bodies that the book does not have."""

SYSTEMS = (
    "slider_crank",
    "four_bar",
    "n_link_loop",
    "chaplygin_sleigh",
    "knife_edge_incline",
    "nonholonomic_particle",
    "vertical_rolling_disk",
    "rolling_disk",
    "rolling_ball_turntable",
    "chaplygin_ball",
    "snakeboard",
    "suslov",
    "torque_free_asymmetric_top",
    "heavy_symmetric_top",
)
