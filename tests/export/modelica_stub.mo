// What the wired example names of Modelica's library: connectors and parts in our own words.
package Modelica
  package Electrical
    package Analog
      package Interfaces
        connector PositivePin Real v; flow Real i; end PositivePin;
        connector NegativePin Real v; flow Real i; end NegativePin;
      end Interfaces;
      package Basic
        model Ground
          Interfaces.PositivePin p;
        equation
          p.v = 0;
        end Ground;
      end Basic;
      package Sources
        model SineVoltage
          parameter Real V; parameter Real f; parameter Real phase = 0; parameter Real offset = 0;
          Interfaces.PositivePin p;
          Interfaces.NegativePin n;
        equation
          p.v - n.v = offset + V*sin(6.283185307179586*f*time + phase);
          p.i + n.i = 0;
        end SineVoltage;
      end Sources;
    end Analog;
  end Electrical;
  package Mechanics
    package Translational
      package Interfaces
        connector Flange_a Real s; flow Real f; end Flange_a;
        connector Flange_b Real s; flow Real f; end Flange_b;
      end Interfaces;
      package Components
        model SpringDamper
          parameter Real c; parameter Real d;
          Interfaces.Flange_a flange_a;
          Interfaces.Flange_b flange_b;
          Real s_rel;
          Real v_rel;
          Real f;
        equation
          s_rel = flange_b.s - flange_a.s;
          v_rel = der(s_rel);
          f = c*s_rel + d*v_rel;
          flange_b.f = f;
          flange_a.f = -f;
        end SpringDamper;
        model Mass
          parameter Real m;
          Real s; Real v;
          Interfaces.Flange_a flange_a;
          Interfaces.Flange_b flange_b;
        equation
          flange_a.s = s;
          flange_b.s = s;
          v = der(s);
          m*der(v) = flange_a.f + flange_b.f;
        end Mass;
      end Components;
    end Translational;
  end Mechanics;
end Modelica;
