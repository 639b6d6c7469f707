"""One sentence form for every error: argument, requirement, what it was, likely fix."""


class SimulationError(RuntimeError):
    """A simulation ended in a status other than `Status.ok`.

    Attributes:
        motion: the `Solution` up to the failure; rows not reached are NaN.
    """

    def __init__(self, message: str, motion: object = None) -> None:
        super().__init__(message)
        self.motion = motion


class EquilibriumError(RuntimeError):
    """A search for a state of rest found none.

    Attributes:
        equilibrium: the `Equilibrium` with the nearest point and the forces left there.
    """

    def __init__(self, message: str, equilibrium: object = None) -> None:
        super().__init__(message)
        self.equilibrium = equilibrium


class AssemblyError(RuntimeError):
    """No state near satisfies the constraints.

    Attributes:
        assembly: the `Assembly` with the nearest state and the residuals left there.
    """

    def __init__(self, message: str, assembly: object = None) -> None:
        super().__init__(message)
        self.assembly = assembly


def requirement(argument: str, must: str, was: str, fix: str = "") -> str:
    """`<argument> must <must>, but <was>. <fix>`."""
    return f"{argument} must {must}, but {was}." + (f" {fix}" if fix else "")


def invalid(argument: str, must: str, was: str, fix: str = "") -> ValueError:
    """A `ValueError` in the form of `requirement`, to be raised by the caller."""
    return ValueError(requirement(argument, must, was, fix))
