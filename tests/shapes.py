"""An import hook that checks at run time the shapes that echelon declares.

jaxtyping's own hook wraps every function, and most declare no shape: it made the tests take half as
long again.
"""

import ast
import importlib.machinery
import re
import sys

from beartype import beartype
from jaxtyping import jaxtyped

SHAPED = re.compile(r"\b(State|Input|Output|InputMap|Scalar|Float)s?\b")
"""How the types with shapes of echelon.core.types are named."""


def checked(function):
    """Check what is declared with a shape; a wrong type is for echelon to refuse, as for a user."""
    hints = function.__annotations__.items()
    shaped = {name: hint for name, hint in hints if "jaxtyping" in repr(hint)}
    if not shaped:
        return function
    function.__annotations__ = shaped
    return jaxtyped(function, typechecker=beartype)


class _Decorate(ast.NodeTransformer):
    def visit_FunctionDef(self, node):
        self.generic_visit(node)
        every = [*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs]
        hints = [arg.annotation for arg in every] + [node.returns]
        if any(hint is not None and SHAPED.search(ast.unparse(hint)) for hint in hints):
            # The innermost, so that what else decorates it sees what is checked.
            node.decorator_list.append(ast.parse("__import__('shapes').checked", mode="eval").body)
            ast.fix_missing_locations(node)
        return node


class _Loader(importlib.machinery.SourceFileLoader):
    def get_code(self, fullname):
        # Anew, and not from a file of bytecode that others would read without checks.
        path = self.get_filename(fullname)
        tree = ast.parse(self.get_data(path), path)
        return compile(_Decorate().visit(tree), path, "exec", dont_inherit=True)


class _Finder:
    def find_spec(self, name, path=None, target=None):
        if name != "echelon" and not name.startswith("echelon."):
            return None
        spec = importlib.machinery.PathFinder.find_spec(name, path, target)
        if spec is not None and isinstance(spec.loader, importlib.machinery.SourceFileLoader):
            spec.loader = _Loader(spec.loader.name, spec.loader.path)
        return spec


def check_shapes():
    """Check the shapes in all of echelon that is imported from here on."""
    sys.meta_path.insert(0, _Finder())
