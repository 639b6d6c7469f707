"""The loop of steps of many trajectories as one vectorized loop over them."""

from jaxlag._integration._vector_loop._choice import may_vectorize as may_vectorize
from jaxlag._integration._vector_loop._lane_call import lane_call as lane_call
from jaxlag._integration._vector_loop._lane_loop import lane_loop as lane_loop
from jaxlag._integration._vector_loop._lane_map import WIDTH as WIDTH
from jaxlag._integration._vector_loop._turn import NotVectorizable as NotVectorizable
