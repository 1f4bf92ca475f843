"""A griffe extension: prepares docstrings and the quantities of an equilibrium for the site."""

import re
from typing import Any

from griffe import Attribute, Class, Extension, Function, Object, Parameter, Parameters

LIST = re.compile(r"(\*\*[A-Z]\w*:\*\*)\n- ")


class Docstrings(Extension):
    """Starts lists after a blank line, as Markdown requires, and shows quantities as they are used:
    `eq.tip`, `eq.position(X)`."""

    def on_object(self, *, obj: Object, **_: Any) -> None:
        if obj.docstring:
            obj.docstring.value = LIST.sub(r"\1\n\n- ", obj.docstring.value)

    def on_class_members(self, *, cls: Class, **_: Any) -> None:
        for name, member in list(cls.members.items()):
            kinds = {decorator.callable_path for decorator in getattr(member, "decorators", [])}
            if any(kind.endswith(".quantity") for kind in kinds):
                cls.set_member(name, as_attribute(member))
            elif any(kind.endswith(".along_arm") for kind in kinds):
                member.parameters = Parameters(Parameter("self"), Parameter("X"))


def as_attribute(function: Function) -> Attribute:
    """A function without arguments as the attribute that a descriptor makes of it."""
    made = Attribute(
        function.name,
        annotation=function.returns,
        lineno=function.lineno,
        endlineno=function.endlineno,
        docstring=function.docstring,
        parent=function.parent,
    )
    made.labels.add("property")
    return made
