"""What to do about an effect, by the code of its remedy; which record shows it, by its test."""

from collections.abc import Mapping

_FEED_FORWARD = "correct the voltage by the extended model (feed-forward)"

#: What can be done. Those below the line are the kinds of effects of a model of one's own.
DO: Mapping[str, str] = {
    "extended_model": "Use the extended model in the place of the base",
    "wait_or_feed_forward": (
        f"Wait until it has died out, close a loop around a position sensor, or {_FEED_FORWARD}"
    ),
    "undo_hysteresis": (
        f"Approach every position from the same side, {_FEED_FORWARD} or by a hysteresis"
        " compensator, drive the charge instead of the voltage, or close a loop"
    ),
    "undo_curve": f"Use less of the range, {_FEED_FORWARD}, or close a loop",
    "control_charge": (
        "Give the amplifier the current that the larger capacitance takes, or drive the charge"
    ),
    "avoid_resonance": (
        "Keep the drive below that frequency (longer edges, a notch filter), or stiffen or damp"
        " what rings"
    ),
    "undo_load_curve": (
        "Find what the output works against (guide, disc spring, contact) and make it linear, or"
        f" {_FEED_FORWARD}"
    ),
    "preload": (
        "Preload or clamp the joint so that it keeps its contact, or stay on one side of where it"
        " is lost"
    ),
    "cool": f"Drive slower or less far, let it rest between fast runs, cool it, or {_FEED_FORWARD}",
    "identify_again": "Identify the gain again from time to time, or close a loop",
    "more_current": "Use longer edges, or an amplifier that delivers more current",
    "stay_below_level": "Stay below the level, or use an amplifier that puts out more voltage",
    "better_drive": "Drive slower, use an amplifier with more bandwidth, or let the model lead",
    "measure_voltage": (
        "Record the voltage at the stack in the place of the command, calibrate the amplifier, or"
        f" {_FEED_FORWARD}"
    ),
    "hold_charge": (
        "Give the charge drive a longer time constant, control the voltage in slow motion, or close"
        " a loop"
    ),
    "align_clocks": (
        "Shift the reading's time by the delay, or sample both channels by one clock; in a loop the"
        " delay costs phase"
    ),
    "faster_sensor": "Give the sensor more bandwidth, or take the lag off the reading",
    "calibrate_sensor": "Calibrate the sensor against a better one, and correct its reading",
    "zero_again": "Let the sensor warm up, and take its zero before and after every run",
    "shield": (
        "Shield and ground the sensor's cable, average over whole periods, or filter that frequency"
    ),
    "steady_surroundings": (
        "Keep the temperature steady, start when the set-up has warmed up, or record the"
        " temperature and correct by it"
    ),
    # a model of one's own
    "lag": "Drive slower, use a faster device there, or keep the lag in the model",
    "delay": "Shift the time of that signal, sample by one clock, or keep the delay in the model",
    "bend": "Calibrate that signal and correct it by the curve, or keep the curve in the model",
    "saturation": "Stay below the level, or use a device there that reaches further",
    "dead_zone": "Jump over the zone when the sign changes, or make up the play or the threshold",
    "zero": "Take the zero before every run",
    "drift": "Let the sensor warm up, and take its zero before and after every run",
    "constant": "Look for a weight, a leak or the offset of an input, and put it into the equation",
    "loss": "Put the further loss into the equation, or look for what rubs, leaks or cools",
    "friction": "Lubricate or preload what rubs, overcome it by the input, or keep it in the model",
    "drag": "Put the quadratic loss into the equation",
    "curve": "Put the law into the equation in the place of a constant stiffness or conductance",
    "stop": "Stay clear of the stop, or keep it in the model",
    "hysteresis": "Approach from the same side, correct by the extended model, or close a loop",
}

#: The record that shows an effect, by the test that measures it.
RECORDS: Mapping[str, str] = {
    "hold": "a step to the highest voltage, held for ten minutes",
    "reversal": "slow loops of three amplitudes, nested",
    "range": "slow loops over the whole range, again with another load or sensor",
    "slew": "the same loop at three rates, the fastest in use among them",
    "resonance": "a sweep or a multisine that passes the resonance, well sampled",
    "record": "a long record with rests, and with the temperature beside it",
}
