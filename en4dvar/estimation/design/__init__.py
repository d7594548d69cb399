"""The information of an experiment before it is made: expected information, the choice of readings, deciding between
laws.

The expected information gain of readings y about what is asked, a part a of the control vector, is their mutual
information (Lindley 1956, Ann. Math. Stat. 27, 986)

    I = E[ln p(y | a) − ln p(y)],     (x, y) ~ p(x) p(y | x),

in nats. Three estimates of it, from cheap to exact:

    linear    ½ ln det of prior over posterior covariance of a, linearised at the prior mean (exact if F, H are linear)
    laplace   the mean of the same, linearised at draws of the prior (:mod:`en4dvar.estimation.design.planned`)
    nested    both densities by importance sampling with runs of their own (:mod:`en4dvar.estimation.design.nested`)
"""
