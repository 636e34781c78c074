"""Secants in closed form: f(z) - f(0) = s(z) z without a quotient that is 0/0 at z = 0.

Sums, products and powers are telescoped; elementary functions use their addition theorems, with
the named functions sinc, phi1 and tanhc for the quotients that remain.
"""

from collections.abc import Callable

import sympy as sp

from obsynth.symbolic.functions import phi1, tanhc

Rule = Callable[[sp.Expr, sp.Expr], sp.Expr]
_LARGEST_ROOT = 12
_HALF = sp.Rational(1, 2)


def at_zero(expression: sp.Expr, variable: sp.Symbol) -> sp.Expr | None:
    """Value where a variable is zero."""
    value = expression.subs(variable, 0)
    if value.has(sp.zoo, sp.nan, sp.oo, sp.S.NegativeInfinity, sp.I):
        return None
    return value


def secant(expression: sp.Expr, variable: sp.Symbol) -> sp.Expr | None:
    """Slope of the chord from zero: expression - (its value at zero) = secant * variable."""
    if not expression.has(variable):
        return sp.Integer(0)
    if expression == variable:
        return sp.Integer(1)
    if expression.is_Add:
        return _sum([secant(term, variable) for term in expression.args])
    if expression.is_Mul:
        return _product(expression, variable)
    if expression.is_Pow and not expression.exp.has(variable):
        return _power(expression, variable)
    if isinstance(expression, sp.Max | sp.Min) and len(expression.args) == 2:
        return secant(expression.rewrite(sp.Abs), variable)
    rule = _RULES.get(expression.func)
    if rule is None or len(expression.args) != 1:
        return None
    inner = expression.args[0]
    start, slope = at_zero(inner, variable), secant(inner, variable)
    if start is None or slope is None:
        return None
    return _finite(rule(inner, start), slope)


def quotients(expression: sp.Expr) -> sp.Expr:
    """Write sinc, phi1, tanhc and sign as the quotients that they are off zero, acos by asin."""
    return (
        expression.replace(sp.sinc, lambda a: sp.sin(a) / a)
        .replace(phi1, lambda a: (sp.exp(a) - 1) / a)
        .replace(tanhc, lambda a: sp.tanh(a) / a)
        .replace(sp.sign, lambda a: a / sp.Abs(a))
        .replace(sp.acos, lambda a: sp.pi / 2 - sp.asin(a))
    )


def _finite(value: sp.Expr, factor: sp.Expr = sp.S.One) -> sp.Expr | None:
    product = value * factor
    return None if product.has(sp.zoo, sp.nan, sp.oo, sp.S.NegativeInfinity) else product


def _sum(parts: list[sp.Expr | None]) -> sp.Expr | None:
    if any(part is None for part in parts):
        return None
    return sp.Add(*parts)


def _product(expression: sp.Expr, variable: sp.Symbol) -> sp.Expr | None:
    constant, varying = expression.as_independent(variable, as_Add=False)
    factors = _join_signs(sp.Mul.make_args(varying), variable)
    for k, (_, start, slope) in enumerate(factors):
        if start == 0 and slope is not None:
            others = [f for j, (f, _, _) in enumerate(factors) if j != k]
            return _finite(_without_signs(sp.Mul(constant, slope, *others)))
    total = sp.Integer(0)
    for k, (_, start, slope) in enumerate(factors):
        if start is None or slope is None:
            return None
        before = [s for _, s, _ in factors[:k]]
        after = [f for f, _, _ in factors[k + 1 :]]
        total += sp.Mul(constant, *before, slope, *after)
    return _finite(total)


def _without_signs(product: sp.Expr) -> sp.Expr:
    """Write sign(g) g^n as |g| g^(n - 1)."""
    powers = dict(factor.as_base_exp() for factor in sp.Mul.make_args(product))
    for sign in [base for base in powers if isinstance(base, sp.sign)]:
        inner = sign.args[0]
        exponent = powers.get(inner, sp.Integer(0))
        if powers[sign] == 1 and exponent.is_Integer and exponent >= 1:
            product = product / (sign * inner) * sp.Abs(inner)
    return product


def _join_signs(
    factors: tuple[sp.Expr, ...], variable: sp.Symbol
) -> list[tuple[sp.Expr, sp.Expr | None, sp.Expr | None]]:
    """Factors with value at zero and secant; sign(g) |g|^p is one factor, zero with g."""
    rest = list(factors)
    joined: list[tuple[sp.Expr, sp.Expr | None, sp.Expr | None]] = []
    for sign in [f for f in factors if isinstance(f, sp.sign)]:
        inner = sign.args[0]
        if at_zero(inner, variable) != 0:
            continue
        for factor in rest:
            base, exponent = factor.as_base_exp()
            if base == sp.Abs(inner) and exponent.is_positive:
                slope = secant(inner, variable)
                rest.remove(sign)
                rest.remove(factor)
                # sign(-g) and sign(g) share |g|, so the sign stays with its own argument
                value = None if slope is None else sp.Abs(inner) ** (exponent - 1) * slope
                joined.append((sign * factor, sp.Integer(0), value))
                break
    ordered = sorted(rest, key=lambda f: (f != variable, sp.default_sort_key(f)))
    return joined + [(f, at_zero(f, variable), secant(f, variable)) for f in ordered]


def _power(expression: sp.Expr, variable: sp.Symbol) -> sp.Expr | None:
    base, exponent = expression.as_base_exp()
    if base == sp.E:
        return None
    start, slope = at_zero(base, variable), secant(base, variable)
    if start is None or slope is None:
        return None
    if exponent.is_negative:
        positive = secant(base**-exponent, variable)
        if start == 0 or positive is None:
            return None
        return _finite(-positive / (base**-exponent * start**-exponent))
    if start == 0:
        return _finite(base ** (exponent - 1), slope) if exponent.is_positive else None
    if exponent.is_Rational and exponent.q <= _LARGEST_ROOT and exponent.p <= _LARGEST_ROOT:
        root, first = base ** sp.Rational(1, exponent.q), start ** sp.Rational(1, exponent.q)
        top = _chain(root, first, exponent.p)
        return _finite(top / _chain(root, first, exponent.q), slope)
    logarithm = sp.log(base / start)
    growth = phi1(exponent * logarithm) / phi1(logarithm)
    return _finite(exponent * start ** (exponent - 1) * growth, slope)


def _chain(a: sp.Expr, b: sp.Expr, n: int) -> sp.Expr:
    """Return (a^n - b^n)/(a - b)."""
    return sp.Add(*[a**k * b ** (n - 1 - k) for k in range(n)])


def _sinhc(z: sp.Expr) -> sp.Expr:
    return sp.exp(-z) * phi1(2 * z)


def _sin(a: sp.Expr, b: sp.Expr) -> sp.Expr:
    if b == 0:
        return sp.sinc(a)
    return sp.cos((a + b) / 2) * sp.sinc((a - b) / 2)


def _sinh(a: sp.Expr, b: sp.Expr) -> sp.Expr:
    if b == 0:
        return _sinhc(a)
    return sp.cosh((a + b) / 2) * _sinhc((a - b) / 2)


def _log(a: sp.Expr, b: sp.Expr) -> sp.Expr:
    return sp.nan if b == 0 else 1 / (b * phi1(sp.log(a / b)))


def _asin(a: sp.Expr, b: sp.Expr) -> sp.Expr:
    first, second = sp.asin(a), sp.asin(b)
    if b == 0:
        return 1 / sp.sinc(first)
    return 1 / (sp.cos((first + second) / 2) * sp.sinc((first - second) / 2))


def _acosh(a: sp.Expr, b: sp.Expr) -> sp.Expr:
    first, second = sp.acosh(a), sp.acosh(b)
    return 1 / (sp.sinh((first + second) / 2) * _sinhc((first - second) / 2))


def _asinh(a: sp.Expr, b: sp.Expr) -> sp.Expr:
    first, second = sp.asinh(a), sp.asinh(b)
    return 1 / (sp.cosh((first + second) / 2) * _sinhc((first - second) / 2))


def _atan(a: sp.Expr, b: sp.Expr) -> sp.Expr:
    return 1 / (sp.sqrt(1 + a**2) * sp.sqrt(1 + b**2) * sp.sinc(sp.atan(a) - sp.atan(b)))


def _abs(a: sp.Expr, b: sp.Expr) -> sp.Expr:
    return sp.sign(a) if b == 0 else (a + b) / (sp.Abs(a) + sp.Abs(b))


_RULES: dict[type[sp.Expr], Rule] = {
    sp.sin: _sin,
    sp.cos: lambda a, b: -sp.sin((a + b) / 2) * sp.sinc((a - b) / 2),
    sp.tan: lambda a, b: sp.sinc(a - b) / (sp.cos(a) * sp.cos(b)),
    sp.exp: lambda a, b: sp.exp(b) * phi1(a - b),
    sp.log: _log,
    sp.sinh: _sinh,
    sp.cosh: lambda a, b: sp.sinh((a + b) / 2) * _sinhc((a - b) / 2),
    sp.tanh: lambda a, b: tanhc(a - b) * (1 - sp.tanh(a) * sp.tanh(b)),
    sp.asin: _asin,
    sp.acos: lambda a, b: -_asin(a, b),
    sp.atan: _atan,
    sp.asinh: _asinh,
    sp.acosh: _acosh,
    sp.atanh: lambda a, b: 1 / (tanhc(sp.atanh(a) - sp.atanh(b)) * (1 - a * b)),
    sp.Abs: _abs,
}
