"""Dispersion of optical glasses and what it does to the focal length of a thin lens."""

import math
from dataclasses import dataclass

from plenocli.base.errors import ConfigError

_SELLMEIER = """
N-BK7  0.3 2.5  1.03961212 0.00600069867  0.231792344 0.0200179144  1.01046945 103.560653
N-BAK4  0.33 2.5  1.28834642 0.00779980626  0.132817724 0.0315631177  0.945395373 105.965875
N-F2  0.365 2.5  1.39757037 0.00995906143  0.159201403 0.0546931752  1.2686543 119.248346
N-SF11  0.37 2.5  1.73759695 0.013188707  0.313747346 0.0623068142  1.89878101 155.23629
N-SK16  0.31 2.5  1.34317774 0.00704687339  0.241144399 0.0229005  0.994317969 92.7508526
N-SK2  0.31 2.5  1.28189012 0.0072719164  0.257738258 0.0242823527  0.96818604 110.377773
N-SK4  0.334 2.5  1.32993741 0.00716874107  0.228542996 0.0246455892  0.988465211 100.886364
N-SK5  0.3 2.5  0.991463823 0.00522730467  0.495982121 0.0172733646  0.987393925 98.3594579
N-SK14  0.31 2.5  0.936155374 0.00461716525  0.594052018 0.016885927  1.04374583 103.736265
N-SSK2  0.35 2.5  1.4306027 0.00823982975  0.153150554 0.0333736841  1.01390904 106.870822
N-SSK8  0.35 2.5  1.44857867 0.00869310149  0.117965926 0.0421566593  1.06937528 111.300666
N-LAK8  0.31 2.5  1.33183167 0.00620023871  0.546623206 0.0216465439  1.19084015 82.5827736
N-LAK9  0.3 2.5  1.46231905 0.00724270156  0.344399589 0.0243353131  1.15508372 85.4686868
N-LAK12  0.32 2.5  1.17365704 0.00577031797  0.588992398 0.0200401678  0.978014394 95.4873482
N-LAK21  0.32 2.5  1.22718116 0.00602075682  0.420783743 0.0196862889  1.01284843 88.4370099
N-LASF9  0.365 2.5  2.00029547 0.0121426017  0.298926886 0.0538736236  1.80691843 156.530829
N-LASF31A  0.25 2.5  1.96485075 0.00982060155  0.475231259 0.0344713438  1.48360109 110.739863
N-LASF44  0.334 2.5  1.78897105 0.00872506277  0.38675867 0.0308085023  1.30506243 92.7743824
N-LASF46B  0.365 2.5  2.17988922 0.0125805384  0.306495184 0.0567191367  1.56882437 105.316538
N-LAF2  0.35 2.5  1.80984227 0.0101711622  0.15729555 0.0442431765  1.0930037 100.687748
N-LAF21  0.334 2.5  1.87134529 0.0093332228  0.25078301 0.0345637762  1.22048639 83.2404866
N-BAF10  0.35 2.5  1.5851495 0.00926681282  0.143559385 0.0424489805  1.08521269 105.613573
N-BAK1  0.3 2.5  1.12365662 0.00644742752  0.309276848 0.0222284402  0.881511957 107.297751
N-BALF4  0.35 2.5  1.31004128 0.0079659645  0.142038259 0.0330672072  0.964929351 109.19732
N-FK5  0.26 2.5  0.844309338 0.00475111955  0.344147824 0.0149814849  0.910790213 97.8600293
N-FK51A  0.29 2.5  0.971247817 0.00472301995  0.216901417 0.0153575612  0.904651666 168.68133
N-PK51  0.3 2.5  1.15610775 0.00585597402  0.153229344 0.0194072416  0.785618966 140.537046
N-PSK53A  0.32 2.5  1.38121836 0.00706416337  0.196745645 0.0233251345  0.886089205 97.4847345
N-KZFS4  0.334 2.5  1.35055424 0.0087628207  0.197575506 0.0371767201  1.09962992 90.3866994
N-ZK7A  0.3 2.5  1.07509891 0.00676601657  0.168895044 0.0230642817  0.860503983 89.0498778
N-KF9  0.35 2.5  1.19286778 0.00839154696  0.0893346571 0.0404010786  0.920819805 112.572446
F2  0.32 2.5  1.34533359 0.00997743871  0.209073176 0.0470450767  0.937357162 111.886764
F5  0.32 2.5  1.3104463 0.00958633048  0.19603426 0.0457627627  0.96612977 115.011883
N-SF1  0.37 2.5  1.60865158 0.0119654879  0.237725916 0.0590589722  1.51530653 135.521676
N-SF2  0.365 2.5  1.47343127 0.0109019098  0.163681849 0.0585683687  1.36920899 127.404933
N-SF4  0.365 2.5  1.67780282 0.012679345  0.282849893 0.0602038419  1.63539276 145.760496
N-SF5  0.37 2.5  1.52481889 0.011254756  0.187085527 0.0588995392  1.42729015 129.141675
N-SF6  0.37 2.5  1.77931763 0.0133714182  0.338149866 0.0617533621  2.08734474 174.01759
N-SF8  0.37 2.5  1.55075812 0.0114338344  0.209816918 0.0582725652  1.46205491 133.24165
N-SF10  0.38 2.5  1.62153902 0.0122241457  0.256287842 0.0595736775  1.64447552 147.468793
N-SF14  0.365 2.5  1.69022361 0.0130512113  0.288870052 0.061369188  1.7045187 149.517689
N-SF15  0.37 2.5  1.57055634 0.0116507014  0.218987094 0.0597856897  1.50824017 132.709339
N-SF57  0.37 2.5  1.87543831 0.0141749518  0.37375749 0.0640509927  2.30001797 177.389795
N-SF66  0.39 2.5  2.0245976 0.0147053225  0.470187196 0.0692998276  2.59970433 161.817601
SF6  0.365 2.5  1.72448482 0.0134871947  0.390104889 0.0569318095  1.04572858 118.557185
K10  0.3 2.5  1.15687082 0.00809424251  0.0642625444 0.0386051284  0.872376139 104.74773
S-FPL51  0.28 2.4  1.17010505 0.00616203924  0.0475710783 0.0263372876  0.763832445 141.882642
S-FPL53  0.28 2.4  0.983532327 0.00492234955  0.069568814 0.0193581091  1.11409238 264.275294
S-BSL7  0.29 2.4  1.1515019 0.010598413  0.118583612 -0.011822519  1.26301359 129.617662
S-LAH55V  0.365 2.325  1.97025325 0.00991088134  0.30489414 0.0383202295  1.39214665 97.7785249
S-LAH58  0.32 2.4  1.78764964 0.00847378536  0.6526356 0.0313126408  1.79914564 132.788001
S-LAH60  0.34 2.4  1.95243469 0.0106442437  0.30710021 0.0456735302  1.56578094 110.28141
S-LAL18  0.28 2.4  1.50276318 0.0145462356  0.430224497 -0.00332784153  1.3472606 93.3508342
S-LAM66  0.35 2.4  1.92094221 0.0115075241  0.219901208 0.0547993543  1.72705231 120.133674
S-TIM2  0.36 2.4  1.42193846 0.0107291511  0.133827968 0.0572587546  1.45060574 145.381805
S-TIH6  0.37 2.4  1.77227611 0.0131182633  0.34569125 0.0614479619  2.40788501 200.753254
S-TIH53  0.37 2.4  1.87904886 0.014412177  0.369719775 0.063881799  2.33730863 182.66818
S-PHM52  0.33 2.4  1.0996655 0.0132718559  0.478125422 -0.000601649685  1.13214074 130.595472
S-NPH2  0.39 2.4  2.0386951 0.0170796224  0.437269641 0.0749254813  2.96711461 174.155354
L-BAL35  0.3 2.4  1.1626263 0.0125957437  0.325661051 -0.0032691105  1.35132486 119.214596
S-FTM16  0.35 2.4  1.32940907 0.0102377287  0.141512125 0.0578081956  1.44299068 150.597139
S-LAL10  0.31 2.4  1.52812575 0.00776817644  0.367965267 0.0272026548  1.11751784 88.86974
fused silica  0.21 3.71  0.6961663 0.0684043^2  0.4079426 0.1162414^2  0.8974794 9.896161^2
PMMA  0.43 1.06  1.1819 0.011313
polycarbonate  0.43 1.06  1.4182 0.021304
polystyrene  0.43 1.06  1.4435 0.020216
"""
"""Name, range of wavelengths (um) that the fit holds for, and B C of each Sellmeier term
n^2 - 1 = sum B l^2/(l^2 - C), l in um, two blanks between them. Data sheets of Schott and of Ohara
(S-*, L-*), Malitson 1965 (fused silica), Sultanova, Kasarova and Nikolov 2009 (plastics).
"""


def _catalogue() -> dict[str, tuple[tuple, tuple]]:
    """Name -> (((B, C), ...), (least, greatest) wavelength in um)."""

    def number(text: str) -> float:
        return float(text.removesuffix("^2")) ** (2 if text.endswith("^2") else 1)

    found = {}
    for line in _SELLMEIER.strip().splitlines():
        name, *columns = line.split("  ")
        limits, *terms = (tuple(map(number, column.split())) for column in columns)
        found[name] = tuple(terms), limits
    return found


_ALIASES = {
    "BK7": "N-BK7",
    "SF11": "N-SF11",
    "BAK4": "N-BAK4",
    "SILICA": "fused silica",
    "FUSED-SILICA": "fused silica",
}

_GLASSES = _catalogue()
GLASSES = tuple(_GLASSES)
"""Names that `refractive_index` knows, beside "none" (no dispersion)."""


@dataclass(frozen=True)
class Medium:
    """What light runs through: a dispersion formula with l the wavelength in micrometres, as data
    sheets print it.

    formula, coefficients:
        "constant": (n,);
        "sellmeier": ((B, C), ...), n^2 = 1 + sum B l^2/(l^2 - C);
        "polynomial": ((a, p), ...), n^2 = sum a l^p (Schott before 1992, Hoya, Hikari);
        "cauchy": ((a, p), ...), n = sum a l^p;
        "abbe": (nd, Vd), n = a + b/l + c/l^3.5 (Conrady) through nd, Vd and the partial dispersion
            of normal glasses;
    limits: (least, greatest) wavelength that the formula holds for, m.
    """

    name: str
    formula: str
    coefficients: tuple
    limits: tuple[float, float] = (0.0, math.inf)

    def index(self, wavelength: float) -> float:
        """Index of refraction relative to air.

        wavelength: m.

        Raises ConfigError outside the formula's range and where it gives no index.
        """
        low, high = self.limits
        if not low * (1 - 1e-9) <= wavelength <= high * (1 + 1e-9):
            raise ConfigError(
                (
                    f"{self.name} is described from {low * 1e6:.6g} to {high * 1e6:.6g} um, not at "
                    f"{wavelength * 1e6:.4g} um"
                ),
                "glass",
                'use glass = "none" or another wavelength',
            )
        value = _squared_index(self.formula, self.coefficients, wavelength * 1e6)
        if not value >= 1:
            raise ConfigError(
                (
                    f"the dispersion formula of {self.name} gives no index of refraction at "
                    f"{wavelength * 1e6:.4g} um"
                ),
                "glass",
                "check its coefficients",
            )
        return math.sqrt(value)


def _squared_index(formula: str, coefficients: tuple, l: float) -> float:
    if formula == "constant":
        return coefficients[0] ** 2
    if formula == "sellmeier":
        return 1 + sum(b * l * l / (l * l - c) for b, c in coefficients)
    if formula == "abbe":
        formula, coefficients = "cauchy", _conrady(*coefficients)
    total = sum(a * l**p for a, p in coefficients)
    return total if formula == "polynomial" else total * abs(total)


_LINE_D, _LINE_F, _LINE_C, _LINE_G = 0.5875618, 0.4861327, 0.6562725, 0.4358343
"""Fraunhofer's lines d, F, C and g, um."""


def _conrady(nd: float, vd: float) -> tuple[tuple[float, float], ...]:
    """Terms (a, p) of n = a + b/l + c/l^3.5 from nd and Vd = (nd - 1)/(nF - nC); the third
    condition is that of normal glasses, (ng - nF)/(nF - nC) = 0.6438 - 0.001682 Vd (Schott TIE-29).
    """
    spread = (nd - 1) / vd
    rows = [(_LINE_F**p - _LINE_C**p, _LINE_G**p - _LINE_F**p) for p in (-1.0, -3.5)]
    (f1, g1), (f2, g2) = rows
    first, second = spread, spread * (0.6438 - 0.001682 * vd)
    det = f1 * g2 - f2 * g1
    b, c = (first * g2 - second * f2) / det, (f1 * second - g1 * first) / det
    return (nd - b / _LINE_D - c * _LINE_D**-3.5, 0.0), (b, -1.0), (c, -3.5)


AIR = Medium("air", "constant", (1.0,))


def medium(name: str) -> Medium:
    """The catalogue's Medium of a glass, or AIR.

    Raises ConfigError for a name that is not known.
    """
    if name.lower() == "air":
        return AIR
    key = next((g for g in GLASSES if g.upper() == name.upper()), _ALIASES.get(name.upper()))
    if key is None:
        raise ConfigError(
            f"{name!r} is not a known glass", "glass", f"use one of none, {', '.join(GLASSES)}"
        )
    terms, (low, high) = _GLASSES[key]
    return Medium(key, "sellmeier", terms, (low * 1e-6, high * 1e-6))


def refractive_index(name: str, wavelength: float) -> float:
    """Index of refraction of a glass, in air, to the accuracy of the Sellmeier fit.

    wavelength: m.

    Raises ConfigError for a name that is not known or a wavelength outside the fitted range.
    """
    return medium(name).index(wavelength)


def focal_length(f0: float, glass: str, design_wavelength: float, wavelength: float) -> float:
    """Focal length of a thin singlet, by the lensmaker's equation for fixed curvatures:
    f(l) = f0 (n(l0) - 1)/(n(l) - 1).

    f0: at the design wavelength, m;
    glass: its name, "none" keeps f0;
    design_wavelength, wavelength: m.

    Returns m.
    Raises ConfigError as refractive_index.
    """
    if glass.lower() == "none":
        return f0
    return (
        f0
        * (refractive_index(glass, design_wavelength) - 1)
        / (refractive_index(glass, wavelength) - 1)
    )
