// The stage between a spring to the ground and a position that is given.
model Mover
  Modelica.Mechanics.Translational.Interfaces.Flange_b flange_b;
  Real s(start=0, fixed=true);
equation
  der(s) = 1e-4;
  flange_b.s = s;
end Mover;
model Bench
  Stage.Acausal stage;
  Mover mover;
equation
  connect(mover.flange_b, stage.flange_a);
end Bench;
