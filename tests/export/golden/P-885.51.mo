package PiezoStack "model of a device, written by psa_casadi"

  model Signal "the model with plain inputs and outputs"
    extends Icons.Stack;
    input Real voltage(unit="V", start=0.0, nominal=120.0) "voltage command to the amplifier";
    input Real load_force(unit="N", start=0.0, nominal=876.0) "external force on the output mass, positive outward";
    output Real current(unit="A", displayUnit="mA", nominal=0.18) "current into the stack";
    output Real charge(unit="C", displayUnit="uC", nominal=0.00018) "charge on the stack's electrodes";
    output Real displacement(unit="m", displayUnit="um", nominal=2.1e-05) "displacement of the stack's output";
    output Real velocity(unit="m/s", displayUnit="um/s", nominal=4.7) "velocity of the stack's output";
    output Real blocked_force(unit="N", nominal=876.0) "force that would hold the output at zero displacement";
    // drive: amplifier of gain G and output resistance R_s charging the stack (C_p)
    parameter Real G(unit="1", min=0.001, max=10000.0) = 1.0 "voltage gain of the amplifier";
    parameter Real R_s(unit="Ohm", min=0.001, max=10000000.0) = 8.0 "output resistance of amplifier and leads";
    parameter Real C_p(unit="F", displayUnit="uF", min=1e-10, max=0.01) = 1.5e-06 "capacitance of the stack";
    parameter Real u_rated(unit="V", min=0.001, max=100000.0) = 120.0 "rated voltage span, sets nominal sizes";
    Real u(unit="V", start=0.0, fixed=true, nominal=120.0) "voltage at the stack's electrodes";
    // linear_force: force proportional to the voltage at the electrodes
    parameter Real k_L(unit="N/V", min=1e-06, max=1000000.0) = 7.3 "linear force per volt";
    // bouc_wen: asymmetric Bouc-Wen hysteresis force
    parameter Real A(unit="N/V", min=-100000.0, max=100000.0) = -1.825 "slope of the hysteresis force";
    parameter Real beta(unit="N/V", min=-100000.0, max=100000.0) = 2.0805 "dissipative bend";
    parameter Real gamma(unit="N/V", min=-100000.0, max=100000.0) = 0.2847 "elastic bend";
    parameter Real delta(unit="N/(V.s)", min=-100000.0, max=100000.0) = -0.146 "asymmetry of the paper";
    parameter Real n(unit="1", min=1.0, max=4.0) = 1.5 "sharpness of the bend";
    parameter Real h_ref(unit="N", min=1e-09, max=10000000.0) = 65.7 "reference force that makes (|f_H|/h_ref)^n pure";
    parameter Real hold_rate(unit="V/s", min=1e-09, max=1000000.0) = 0.12 "voltage rate below which the voltage counts as held";
    Real f_H(unit="N", start=0.0, fixed=true, nominal=65.7) "hysteresis force";
    // creep_lag: first-order lag of the generated force (the paper's creep)
    parameter Real tau(unit="s", displayUnit="ms", min=1e-07, max=1.0) = 0.0001 "time constant of the force";
    Real f_out(unit="N", start=0.0, fixed=true, nominal=876.0) "force after the lag";
    // cascade_mechanics: one-way cascade of the wafers' and the bonding layers' oscillator
    parameter Real m_P(unit="kg", min=1e-09, max=1000.0) = 0.0012 "equivalent mass of the wafers";
    parameter Real c_P(unit="N.s/m", min=1e-06, max=1000000000.0) = 1300.0 "equivalent damping of the wafers";
    parameter Real k_P(unit="N/m", min=1.0, max=1000000000000.0) = 250000000.0 "equivalent stiffness of the wafers";
    parameter Real m_B(unit="kg", min=1e-09, max=1000.0) = 0.001 "equivalent mass of the bonding layers";
    parameter Real c_B(unit="N.s/m", min=1e-06, max=1000000000.0) = 670.0 "equivalent damping of the bonding layers";
    parameter Real k_B(unit="N/m", min=1.0, max=1000000000000.0) = 50000000.0 "equivalent stiffness of the bonding layers";
    Real y(unit="m", displayUnit="um", start=0.0, fixed=true, nominal=2.1e-05) "displacement of the wafers";
    Real v_y(unit="m/s", displayUnit="um/s", start=0.0, fixed=true, nominal=4.7) "velocity of the wafers";
    Real x(unit="m", displayUnit="um", start=0.0, fixed=true, nominal=2.1e-05) "displacement of the output mass";
    Real v_x(unit="m/s", displayUnit="um/s", start=0.0, fixed=true, nominal=4.7) "velocity of the output mass";
  protected
    Real drive_voltage(unit="V") "open-circuit voltage of the amplifier";
    Real drive_current(unit="A") "current through the amplifier's output resistance";
    Real stack_current(unit="A") "current into the stack's capacitance";
    Real stack_charge(unit="C") "charge on the stack's electrodes";
    Real voltage_rate(unit="V/s") "rate of the voltage at the stack's electrodes";
    Real hysteresis_rate(unit="N/s") "rate of the hysteresis force";
    Real free_force(unit="N") "force the wafers generate before the creep lag";
    Real wafer_force(unit="N") "force that accelerates and strains the wafers";
    Real transmitted_force(unit="N") "force the wafers pass on to the output mass";
    Real tip_force(unit="N") "force on the output mass from outside the stack";
    Real tip_displacement(unit="m") "displacement of the output mass";
    Real voltage_direction(unit="1") "smooth sign of the voltage rate";
    Real voltage_speed(unit="V/s") "magnitude of the voltage rate";
    Real hysteresis_ratio(unit="1") "hysteresis force over its reference";
    Real hysteresis_signed_bend(unit="1") "the same with the sign of the ratio";
    Real hysteresis_bend(unit="1") "magnitude of the ratio to the power n";
    Real bonding_force(unit="N") "force of the bonding layers' spring and damper";
  equation
    // what several equations use
    voltage_direction = voltage_rate/sqrt(voltage_rate^2 + hold_rate^2);
    voltage_speed = voltage_rate*voltage_direction;
    hysteresis_ratio = f_H/h_ref;
    hysteresis_signed_bend = hysteresis_ratio*(hysteresis_ratio^2 + 1e-24)^((n - 1)/2);
    hysteresis_bend = (hysteresis_ratio^2 + 1e-24)^(n/2);
    bonding_force = c_B*(v_x - v_y) + k_B*(x - y);
    // balances: sums of what the components add
    drive_voltage = G*voltage; // drive
    drive_current = (drive_voltage - u)/R_s; // drive
    stack_current = drive_current; // drive
    stack_charge = C_p*u; // drive
    voltage_rate = stack_current/C_p; // drive
    hysteresis_rate = A*voltage_rate - beta*voltage_speed*hysteresis_signed_bend -
      gamma*voltage_rate*hysteresis_bend + delta*u*voltage_direction;
    free_force = k_L*u + f_H; // linear_force, bouc_wen
    wafer_force = f_out; // creep_lag
    transmitted_force = c_P*v_y + k_P*y; // cascade_mechanics
    tip_force = load_force; // cascade_mechanics
    tip_displacement = x; // cascade_mechanics
    displacement = tip_displacement; // cascade_mechanics
    blocked_force = transmitted_force + c_B*v_y + k_B*y; // cascade_mechanics
    // drive: circuit of a stack on a voltage amplifier; supplies u' to Yang and Zhu 2015, eq. 8
    der(u) = voltage_rate;
    // bouc_wen: Yang and Zhu 2015, eq. 8, read with sgn(u') as its eqs. 28, 31 and 34 require
    der(f_H) = hysteresis_rate;
    // creep_lag: Yang and Zhu 2015, eq. 9 in the causal form that its eq. 13 uses
    der(f_out) = (free_force - f_out)/tau;
    // cascade_mechanics: Yang and Zhu 2015, eqs. 4 and 5, with an external force on the output mass
    der(y) = v_y;
    der(v_y) = (wafer_force - transmitted_force)/m_P;
    der(x) = v_x;
    der(v_x) = (transmitted_force + tip_force - bonding_force)/m_B;
    // outputs
    current = stack_current;
    charge = stack_charge;
    velocity = der(x);
    annotation(Documentation(info="<html>
  <p>co-fired PICMA stack of Physik Instrumente, 120 V, 18 um, 1.5 uF, overdamped; 5 x 5 x 18 mm (the paper's type name is lost; the figures are those of the P-885.51). The force scale is assumed: only quantities scaled to displacement are identified; forces, masses, damping and stiffness share one unknown factor. Named stack P-885.51: 14 of its 19 figures are assumed; `psa stacks P-885.51` shows which.</p>
  <p>Written by psa_casadi 1.0.0.</p>
  <table>
  <tr><th>component</th><th>what it is</th><th>equation</th><th>source</th></tr>
  <tr><td>drive</td><td>amplifier of gain G and output resistance R_s charging the stack (C_p)</td><td>C_p u' = i,  i = (G v - u) / R_s</td><td>circuit of a stack on a voltage amplifier; supplies u' to Yang and Zhu 2015, eq. 8</td></tr>
  <tr><td>linear_force</td><td>force proportional to the voltage at the electrodes</td><td>f_L = k_L u</td><td>Yang and Zhu 2015, eq. 7 with f_0 = 0</td></tr>
  <tr><td>bouc_wen</td><td>asymmetric Bouc-Wen hysteresis force</td><td>f_H' = A u' - beta |u'| sgn(f_H) (|f_H|/h_ref)^n - gamma u' (|f_H|/h_ref)^n + delta u sgn(u')</td><td>Yang and Zhu 2015, eq. 8, read with sgn(u') as its eqs. 28, 31 and 34 require</td></tr>
  <tr><td>creep_lag</td><td>first-order lag of the generated force (the paper's creep)</td><td>tau f_out' + f_out = f_L + f_H</td><td>Yang and Zhu 2015, eq. 9 in the causal form that its eq. 13 uses</td></tr>
  <tr><td>cascade_mechanics</td><td>one-way cascade of the wafers' and the bonding layers' oscillator</td><td>m_P y'' + c_P y' + k_P y = f_out;  m_B x'' + c_B (x' - y') + k_B (x - y) = c_P y' + k_P y + f_load</td><td>Yang and Zhu 2015, eqs. 4 and 5, with an external force on the output mass</td></tr>
  </table>
  </html>"));
  end Signal;

  model Acausal "the model with connectors of the Modelica Standard Library 4"
    extends Icons.Stack;
    Modelica.Electrical.Analog.Interfaces.PositivePin pin_p "positive terminal of the stack"
      annotation(Placement(transformation(extent={{-110, 40}, {-90, 60}})));
    Modelica.Electrical.Analog.Interfaces.NegativePin pin_n "negative terminal of the stack"
      annotation(Placement(transformation(extent={{-110, -60}, {-90, -40}})));
    Modelica.Mechanics.Translational.Interfaces.Flange_b flange_b "output of the stack"
      annotation(Placement(transformation(extent={{90, -10}, {110, 10}})));
    Real current(unit="A", displayUnit="mA", nominal=0.18) "current into the stack";
    Real charge(unit="C", displayUnit="uC", nominal=0.00018) "charge on the stack's electrodes";
    Real displacement(unit="m", displayUnit="um", nominal=2.1e-05) "displacement of the stack's output";
    Real velocity(unit="m/s", displayUnit="um/s", nominal=4.7) "velocity of the stack's output";
    Real blocked_force(unit="N", nominal=876.0) "force that would hold the output at zero displacement";
    // drive: amplifier of gain G and output resistance R_s charging the stack (C_p)
    parameter Real G(unit="1", min=0.001, max=10000.0) = 1.0 "voltage gain of the amplifier";
    parameter Real R_s(unit="Ohm", min=0.001, max=10000000.0) = 8.0 "output resistance of amplifier and leads";
    parameter Real C_p(unit="F", displayUnit="uF", min=1e-10, max=0.01) = 1.5e-06 "capacitance of the stack";
    parameter Real u_rated(unit="V", min=0.001, max=100000.0) = 120.0 "rated voltage span, sets nominal sizes";
    Real u(unit="V", start=0.0, fixed=true, nominal=120.0) "voltage at the stack's electrodes";
    // linear_force: force proportional to the voltage at the electrodes
    parameter Real k_L(unit="N/V", min=1e-06, max=1000000.0) = 7.3 "linear force per volt";
    // bouc_wen: asymmetric Bouc-Wen hysteresis force
    parameter Real A(unit="N/V", min=-100000.0, max=100000.0) = -1.825 "slope of the hysteresis force";
    parameter Real beta(unit="N/V", min=-100000.0, max=100000.0) = 2.0805 "dissipative bend";
    parameter Real gamma(unit="N/V", min=-100000.0, max=100000.0) = 0.2847 "elastic bend";
    parameter Real delta(unit="N/(V.s)", min=-100000.0, max=100000.0) = -0.146 "asymmetry of the paper";
    parameter Real n(unit="1", min=1.0, max=4.0) = 1.5 "sharpness of the bend";
    parameter Real h_ref(unit="N", min=1e-09, max=10000000.0) = 65.7 "reference force that makes (|f_H|/h_ref)^n pure";
    parameter Real hold_rate(unit="V/s", min=1e-09, max=1000000.0) = 0.12 "voltage rate below which the voltage counts as held";
    Real f_H(unit="N", start=0.0, fixed=true, nominal=65.7) "hysteresis force";
    // creep_lag: first-order lag of the generated force (the paper's creep)
    parameter Real tau(unit="s", displayUnit="ms", min=1e-07, max=1.0) = 0.0001 "time constant of the force";
    Real f_out(unit="N", start=0.0, fixed=true, nominal=876.0) "force after the lag";
    // cascade_mechanics: one-way cascade of the wafers' and the bonding layers' oscillator
    parameter Real m_P(unit="kg", min=1e-09, max=1000.0) = 0.0012 "equivalent mass of the wafers";
    parameter Real c_P(unit="N.s/m", min=1e-06, max=1000000000.0) = 1300.0 "equivalent damping of the wafers";
    parameter Real k_P(unit="N/m", min=1.0, max=1000000000000.0) = 250000000.0 "equivalent stiffness of the wafers";
    parameter Real m_B(unit="kg", min=1e-09, max=1000.0) = 0.001 "equivalent mass of the bonding layers";
    parameter Real c_B(unit="N.s/m", min=1e-06, max=1000000000.0) = 670.0 "equivalent damping of the bonding layers";
    parameter Real k_B(unit="N/m", min=1.0, max=1000000000000.0) = 50000000.0 "equivalent stiffness of the bonding layers";
    Real y(unit="m", displayUnit="um", start=0.0, fixed=true, nominal=2.1e-05) "displacement of the wafers";
    Real v_y(unit="m/s", displayUnit="um/s", start=0.0, fixed=true, nominal=4.7) "velocity of the wafers";
    Real x(unit="m", displayUnit="um", start=0.0, fixed=true, nominal=2.1e-05) "displacement of the output mass";
    Real v_x(unit="m/s", displayUnit="um/s", start=0.0, fixed=true, nominal=4.7) "velocity of the output mass";
    // reciprocal_coupling: the bonding layers push back on the wafers: two masses with action and reaction
    final parameter Real reciprocal_gain(unit="1", min=0.0, max=1.2) = 1.0 "share of the reaction: 0 the paper's cascade, 1 Newton; more only in error";
    Real y_r(unit="m", displayUnit="um", start=0.0, fixed=true, nominal=2.1e-05) "change of y from holding the output at zero, over the gain";
    Real v_r(unit="m/s", displayUnit="um/s", start=0.0, fixed=true, nominal=4.7) "its rate";
  protected
    Real voltage(unit="V", start=0.0, nominal=120.0) "voltage command to the amplifier";
    Real load_force(unit="N", start=0.0, nominal=876.0) "external force on the output mass, positive outward";
    Real drive_voltage(unit="V") "open-circuit voltage of the amplifier";
    Real drive_current(unit="A") "current through the amplifier's output resistance";
    Real stack_current(unit="A") "current into the stack's capacitance";
    Real stack_charge(unit="C") "charge on the stack's electrodes";
    Real voltage_rate(unit="V/s") "rate of the voltage at the stack's electrodes";
    Real hysteresis_rate(unit="N/s") "rate of the hysteresis force";
    Real free_force(unit="N") "force the wafers generate before the creep lag";
    Real wafer_force(unit="N") "force that accelerates and strains the wafers";
    Real transmitted_force(unit="N") "force the wafers pass on to the output mass";
    Real tip_force(unit="N") "force on the output mass from outside the stack";
    Real tip_displacement(unit="m") "displacement of the output mass";
    Real voltage_direction(unit="1") "smooth sign of the voltage rate";
    Real voltage_speed(unit="V/s") "magnitude of the voltage rate";
    Real hysteresis_ratio(unit="1") "hysteresis force over its reference";
    Real hysteresis_signed_bend(unit="1") "the same with the sign of the ratio";
    Real hysteresis_bend(unit="1") "magnitude of the ratio to the power n";
    Real bonding_force(unit="N") "force of the bonding layers' spring and damper";
    Real elastic_force(unit="N") "force of the wafers' spring and damper";
  equation
    // what several equations use
    voltage_direction = voltage_rate/sqrt(voltage_rate^2 + hold_rate^2);
    voltage_speed = voltage_rate*voltage_direction;
    hysteresis_ratio = f_H/h_ref;
    hysteresis_signed_bend = hysteresis_ratio*(hysteresis_ratio^2 + 1e-24)^((n - 1)/2);
    hysteresis_bend = (hysteresis_ratio^2 + 1e-24)^(n/2);
    bonding_force = c_B*(v_x - v_y) + k_B*(x - y);
    elastic_force = c_P*v_y + k_P*y;
    // balances: sums of what the components add
    drive_voltage = G*voltage; // drive
    drive_current = (drive_voltage - u)/R_s; // drive
    stack_current = drive_current; // drive
    stack_charge = C_p*u; // drive
    voltage_rate = stack_current/C_p; // drive
    hysteresis_rate = A*voltage_rate - beta*voltage_speed*hysteresis_signed_bend -
      gamma*voltage_rate*hysteresis_bend + delta*u*voltage_direction;
    free_force = k_L*u + f_H; // linear_force, bouc_wen
    wafer_force = f_out + reciprocal_gain*bonding_force; // creep_lag, reciprocal_coupling
    transmitted_force =
      c_P*v_y + k_P*y // cascade_mechanics
      - reciprocal_gain*elastic_force; // reciprocal_coupling
    tip_force = load_force; // cascade_mechanics
    tip_displacement = x; // cascade_mechanics
    displacement = tip_displacement; // cascade_mechanics
    blocked_force =
      transmitted_force + c_B*v_y + k_B*y // cascade_mechanics
      + reciprocal_gain*((c_B + (1 - reciprocal_gain)*c_P)*v_r + (k_B + (1 -
        reciprocal_gain)*k_P)*y_r); // reciprocal_coupling
    // drive: circuit of a stack on a voltage amplifier; supplies u' to Yang and Zhu 2015, eq. 8
    der(u) = voltage_rate;
    // bouc_wen: Yang and Zhu 2015, eq. 8, read with sgn(u') as its eqs. 28, 31 and 34 require
    der(f_H) = hysteresis_rate;
    // creep_lag: Yang and Zhu 2015, eq. 9 in the causal form that its eq. 13 uses
    der(f_out) = (free_force - f_out)/tau;
    // cascade_mechanics: Yang and Zhu 2015, eqs. 4 and 5, with an external force on the output mass
    der(y) = v_y;
    der(v_y) = (wafer_force - elastic_force)/m_P;
    der(x) = v_x;
    der(v_x) = (transmitted_force + tip_force - bonding_force)/m_B;
    // reciprocal_coupling: Newton's third law, whose reaction Yang and Zhu 2015, eqs. 4 and 5, leave out
    der(y_r) = v_r;
    der(v_r) = -(c_B*v_x + k_B*x + (c_P + reciprocal_gain*c_B)*v_r + (k_P +
      reciprocal_gain*k_B)*y_r)/m_P;
    // outputs
    current = stack_current;
    charge = stack_charge;
    velocity = der(x);
    // connectors
    pin_p.v - pin_n.v = G*voltage;
    pin_p.i = current;
    pin_p.i + pin_n.i = 0;
    flange_b.s = displacement;
    flange_b.f = load_force;
    annotation(Documentation(info="<html>
  <p>co-fired PICMA stack of Physik Instrumente, 120 V, 18 um, 1.5 uF, overdamped; 5 x 5 x 18 mm (the paper's type name is lost; the figures are those of the P-885.51). The force scale is assumed: only quantities scaled to displacement are identified; forces, masses, damping and stiffness share one unknown factor. Named stack P-885.51: 14 of its 19 figures are assumed; `psa stacks P-885.51` shows which.</p>
  <p>Written by psa_casadi 1.0.0.</p>
  <p>The pins are the terminals behind the amplifier's gain G: between them is G times the voltage command, and the current is what flows into the stack. The motion does not act back on the charge. The flange is the stack's output, its position the displacement from rest, with the other end clamped.</p>
  <p>The paper's one-way cascade has no reaction of the bonding layers on the wafers, so that it cannot be a two-port. This class has it: reciprocal_gain = 1, action and reaction. With the same parameters the static stroke per force is k_B/(k_P + k_B) = 0.1667 times that of the cascade at reciprocal_gain = 0, and the output's stiffness is that of wafers and bonding layers in series, k_P k_B/(k_P + k_B) = 4.167e+07 N/m in place of k_B = 5e+07 N/m. Where the parameters were found with the cascade, find them again with reciprocal_coupling at 1, or scale the forces (k_L, A, beta, gamma, delta, h_ref) by (k_P + k_B)/k_B for the same free stroke.</p>
  <table>
  <tr><th>component</th><th>what it is</th><th>equation</th><th>source</th></tr>
  <tr><td>drive</td><td>amplifier of gain G and output resistance R_s charging the stack (C_p)</td><td>C_p u' = i,  i = (G v - u) / R_s</td><td>circuit of a stack on a voltage amplifier; supplies u' to Yang and Zhu 2015, eq. 8</td></tr>
  <tr><td>linear_force</td><td>force proportional to the voltage at the electrodes</td><td>f_L = k_L u</td><td>Yang and Zhu 2015, eq. 7 with f_0 = 0</td></tr>
  <tr><td>bouc_wen</td><td>asymmetric Bouc-Wen hysteresis force</td><td>f_H' = A u' - beta |u'| sgn(f_H) (|f_H|/h_ref)^n - gamma u' (|f_H|/h_ref)^n + delta u sgn(u')</td><td>Yang and Zhu 2015, eq. 8, read with sgn(u') as its eqs. 28, 31 and 34 require</td></tr>
  <tr><td>creep_lag</td><td>first-order lag of the generated force (the paper's creep)</td><td>tau f_out' + f_out = f_L + f_H</td><td>Yang and Zhu 2015, eq. 9 in the causal form that its eq. 13 uses</td></tr>
  <tr><td>cascade_mechanics</td><td>one-way cascade of the wafers' and the bonding layers' oscillator</td><td>m_P y'' + c_P y' + k_P y = f_out;  m_B x'' + c_B (x' - y') + k_B (x - y) = c_P y' + k_P y + f_load</td><td>Yang and Zhu 2015, eqs. 4 and 5, with an external force on the output mass</td></tr>
  <tr><td>reciprocal_coupling</td><td>the bonding layers push back on the wafers: two masses with action and reaction</td><td>m_P y'' + c_P y' + k_P y = f_out + g F,  F = c_B (x' - y') + k_B (x - y);  m_B x'' + F = (1 - g) (c_P y' + k_P y) + f_load,  g = reciprocal_gain: 0 the paper's cascade, 1 Newton;  y + g y_r is y with the output held at zero, for the blocked force</td><td>Newton's third law, whose reaction Yang and Zhu 2015, eqs. 4 and 5, leave out</td></tr>
  </table>
  </html>"));
  end Acausal;

  package Examples "ready to simulate"
    model Sine "a sine from rest on the first input, the others constant"
      extends Icons.Example;
      parameter Real height(unit="V") = 120.0
        "how far the input swings";
      parameter Real frequency(unit="Hz") = 250.0 "of it";
      Signal device(voltage=0.5*height*(1 - cos(6.283185307179586*frequency*time)), load_force=0.0);
      annotation(experiment(StartTime=0, StopTime=0.016, Interval=1.6e-05, Tolerance=1e-8));
    end Sine;
    model Wired "voltage source, stack, spring and damper, mass"
      extends Icons.Example;
      Acausal stack
        annotation(Placement(transformation(extent={{-20, -20}, {20, 20}})));
      Modelica.Electrical.Analog.Sources.SineVoltage source(V=60.0, f=250.0, offset=60.0,
        phase=-1.5707963267948966) annotation(Placement(transformation(origin={-70, 0}, extent={{-20, -20}, {20, 20}}, rotation=270)));
      Modelica.Electrical.Analog.Basic.Ground ground
        annotation(Placement(transformation(extent={{-80, -60}, {-60, -40}})));
      Modelica.Mechanics.Translational.Components.SpringDamper springDamper(c=4170000.0, d=574.0)
        annotation(Placement(transformation(extent={{30, -10}, {50, 10}})));
      Modelica.Mechanics.Translational.Components.Mass mass(m=0.22, s(start=0, fixed=true), v(start=0, fixed=true))
        annotation(Placement(transformation(extent={{60, -10}, {80, 10}})));
    equation
      connect(source.p, stack.pin_p)
        annotation(Line(points={{-70, 20}, {-70, 30}, {-30, 30}, {-30, 10}, {-20, 10}}, color={0, 0, 255}));
      connect(source.n, stack.pin_n)
        annotation(Line(points={{-70, -20}, {-70, -30}, {-30, -30}, {-30, -10}, {-20, -10}}, color={0, 0, 255}));
      connect(ground.p, stack.pin_n)
        annotation(Line(points={{-70, -40}, {-70, -30}, {-30, -30}, {-30, -10}, {-20, -10}}, color={0, 0, 255}));
      connect(stack.flange_b, springDamper.flange_a)
        annotation(Line(points={{20, 0}, {30, 0}}, color={0, 127, 0}));
      connect(springDamper.flange_b, mass.flange_a)
        annotation(Line(points={{50, 0}, {60, 0}}, color={0, 127, 0}));
      annotation(experiment(StartTime=0, StopTime=0.016, Interval=1.6e-05, Tolerance=1e-8));
    end Wired;
  end Examples;

  package Icons "drawings"
    partial model Stack "a stack of wafers"
      annotation(Icon(graphics={
        Rectangle(extent={{-43.8, 51.6}, {43.8, 68.8}}, lineColor={217, 220, 223}, fillColor={217, 220, 223}, fillPattern=FillPattern.Solid),
        Rectangle(extent={{-43.8, 34.4}, {43.8, 51.6}}, lineColor={217, 220, 223}, fillColor={217, 220, 223}, fillPattern=FillPattern.Solid),
        Rectangle(extent={{-43.8, 17.2}, {43.8, 34.4}}, lineColor={217, 220, 223}, fillColor={217, 220, 223}, fillPattern=FillPattern.Solid),
        Rectangle(extent={{-43.8, 0}, {43.8, 17.2}}, lineColor={217, 220, 223}, fillColor={217, 220, 223}, fillPattern=FillPattern.Solid),
        Rectangle(extent={{-43.8, -17.2}, {43.8, 0}}, lineColor={217, 220, 223}, fillColor={217, 220, 223}, fillPattern=FillPattern.Solid),
        Rectangle(extent={{-43.8, -34.4}, {43.8, -17.2}}, lineColor={217, 220, 223}, fillColor={217, 220, 223}, fillPattern=FillPattern.Solid),
        Rectangle(extent={{-43.8, -51.6}, {43.8, -34.4}}, lineColor={217, 220, 223}, fillColor={217, 220, 223}, fillPattern=FillPattern.Solid),
        Rectangle(extent={{-43.8, -68.8}, {43.8, -51.6}}, lineColor={217, 220, 223}, fillColor={217, 220, 223}, fillPattern=FillPattern.Solid),
        Rectangle(extent={{-43.8, 67.2}, {53.1, 70.3}}, lineColor={230, 159, 0}, fillColor={230, 159, 0}, fillPattern=FillPattern.Solid),
        Rectangle(extent={{-53.1, 50}, {43.8, 53.1}}, lineColor={230, 159, 0}, fillColor={230, 159, 0}, fillPattern=FillPattern.Solid),
        Rectangle(extent={{-43.8, 32.8}, {53.1, 35.9}}, lineColor={230, 159, 0}, fillColor={230, 159, 0}, fillPattern=FillPattern.Solid),
        Rectangle(extent={{-53.1, 15.6}, {43.8, 18.8}}, lineColor={230, 159, 0}, fillColor={230, 159, 0}, fillPattern=FillPattern.Solid),
        Rectangle(extent={{-43.8, -1.6}, {53.1, 1.6}}, lineColor={230, 159, 0}, fillColor={230, 159, 0}, fillPattern=FillPattern.Solid),
        Rectangle(extent={{-53.1, -18.8}, {43.8, -15.6}}, lineColor={230, 159, 0}, fillColor={230, 159, 0}, fillPattern=FillPattern.Solid),
        Rectangle(extent={{-43.8, -35.9}, {53.1, -32.8}}, lineColor={230, 159, 0}, fillColor={230, 159, 0}, fillPattern=FillPattern.Solid),
        Rectangle(extent={{-53.1, -53.1}, {43.8, -50}}, lineColor={230, 159, 0}, fillColor={230, 159, 0}, fillPattern=FillPattern.Solid),
        Rectangle(extent={{-43.8, -70.3}, {53.1, -67.2}}, lineColor={230, 159, 0}, fillColor={230, 159, 0}, fillPattern=FillPattern.Solid),
        Rectangle(extent={{-50, 68.8}, {50, 87.5}}, lineColor={91, 102, 111}, fillColor={91, 102, 111}, fillPattern=FillPattern.Solid),
        Rectangle(extent={{-62.5, -87.5}, {62.5, -68.8}}, lineColor={91, 102, 111}, fillColor={91, 102, 111}, fillPattern=FillPattern.Solid),
        Rectangle(extent={{-56.2, -68.8}, {-51.6, 68.8}}, lineColor={0, 114, 178}, fillColor={0, 114, 178}, fillPattern=FillPattern.Solid),
        Rectangle(extent={{51.6, -68.8}, {56.2, 68.8}}, lineColor={0, 114, 178}, fillColor={0, 114, 178}, fillPattern=FillPattern.Solid),
        Rectangle(extent={{-87.5, -45.3}, {-56.2, -40.6}}, lineColor={0, 114, 178}, fillColor={0, 114, 178}, fillPattern=FillPattern.Solid),
        Rectangle(extent={{56.2, -45.3}, {87.5, -40.6}}, lineColor={0, 114, 178}, fillColor={0, 114, 178}, fillPattern=FillPattern.Solid),
        Text(extent={{-150, 140}, {150, 105}}, textString="%name", textColor={0, 0, 255})
      }));
    end Stack;
    partial model Example "an example"
      annotation(Icon(graphics={Ellipse(extent={{-100, -100}, {100, 100}}), Polygon(points={{-40, 60}, {60, 0}, {-40, -60}}, fillPattern=FillPattern.Solid)}));
    end Example;
  end Icons;

  annotation(Documentation(info="<html>
<p>co-fired PICMA stack of Physik Instrumente, 120 V, 18 um, 1.5 uF, overdamped; 5 x 5 x 18 mm (the paper's type name is lost; the figures are those of the P-885.51). The force scale is assumed: only quantities scaled to displacement are identified; forces, masses, damping and stiffness share one unknown factor. Named stack P-885.51: 14 of its 19 figures are assumed; `psa stacks P-885.51` shows which.</p>
<p>Written by psa_casadi 1.0.0.</p>
<p>Signal needs no library. Acausal has pins and flanges of the Modelica Standard Library 4. All quantities are in SI units; states start at rest.</p>
</html>"), uses(Modelica(version="4.0.0")));
end PiezoStack;
