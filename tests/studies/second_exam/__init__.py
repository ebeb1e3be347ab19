"""A second exam: 72 plants of an author who does not know the method.

Plain NumPy and SciPy, written apart from psa_casadi and from both other sets of plants; of the
first exam only exact linear filters, and the form of the marks, are shared. Loops of Bouc-Wen,
Prandtl-Ishlinskii, Dahl, Coleman-Hodgdon and Preisach; ten seconds to minutes of a laboratory's
voltages; nine noises. Two halves, `tune` and `report`, share the equations of a stack and no plant,
hidden form's parameters or voltage: 10 records of one cause each, three of two, two of three, six
of a foreign cause, 15 clean. The displacement between samples is simulated at 12 steps.

Refitted (gain, loop, the drive's lag, of fast records the mechanics), a healthy model of these
equations leaves 0.92 to 1.01 noise levels of the clean ones (0.72 where the stamps jitter, of which
a slow motion sees nothing) and 8 to 121 of the others, median 19.

If a displacement cannot distinguish two names, both are right: an axis or a floor that leaks into
the reading is a function of time in the environment or at the sensor. A hum at the level of the
noise is right where it is there; pink noise has a slow part by nature, of which nothing is right.
"""
