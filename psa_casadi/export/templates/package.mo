package {{ name }} "model of a device, written by psa_casadi"
{% for text in classes %}

{{ text | indent(2, first=True) }}
{% endfor %}

  package Examples "ready to simulate"
{% if sine %}
    model Sine "a sine from rest on the first input, the others constant"
      extends Icons.Example;
      parameter Real height(unit={{ sine.unit }}) = {{ sine.height }}
        "how far the input swings";
      parameter Real frequency(unit="Hz") = {{ sine.frequency }} "of it";
      Signal device({{ sine.inputs }});
      annotation({{ experiment }});
    end Sine;
{% else %}
    model Free "from the start values, with no input"
      extends Icons.Example;
      Signal device;
      annotation({{ experiment }});
    end Free;
{% endif %}
{% if wired %}
    model Wired "voltage source, stack, spring and damper, mass"
      extends Icons.Example;
      Acausal stack{{ "(" ~ wired.kept ~ ")" if wired.kept }}
{% raw %}        annotation(Placement(transformation(extent={{-20, -20}, {20, 20}})));
{% endraw %}
      Modelica.Electrical.Analog.Sources.SineVoltage source(V={{ wired.swing }}, f={{ wired.frequency }}, offset={{ wired.swing }},
{% raw %}        phase=-1.5707963267948966) annotation(Placement(transformation(origin={-70, 0}, extent={{-20, -20}, {20, 20}}, rotation=270)));
      Modelica.Electrical.Analog.Basic.Ground ground
        annotation(Placement(transformation(extent={{-80, -60}, {-60, -40}})));
{% endraw %}
      Modelica.Mechanics.Translational.Components.SpringDamper springDamper(c={{ wired.c }}, d={{ wired.d }})
{% raw %}        annotation(Placement(transformation(extent={{30, -10}, {50, 10}})));
{% endraw %}
      Modelica.Mechanics.Translational.Components.Mass mass(m={{ wired.m }}, s(start=0, fixed=true), v(start=0, fixed=true))
{% raw %}        annotation(Placement(transformation(extent={{60, -10}, {80, 10}})));
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
{% endraw %}
      annotation({{ wired.experiment }});
    end Wired;
{% endif %}
  end Examples;

  package Icons "drawings"
    partial model {{ drawing | capitalize }} "{{ "a stack of wafers" if drawing == "stack" else "a plain block" }}"
      annotation(Icon(graphics={
{% for extent, colour in rectangles %}
        Rectangle(extent={{ extent }}, lineColor={{ colour }}, fillColor={{ colour }}, fillPattern=FillPattern.Solid),
{% endfor %}
{% raw %}        Text(extent={{-150, 140}, {150, 105}}, textString="%name", textColor={0, 0, 255})
{% endraw %}
      }));
    end {{ drawing | capitalize }};
    partial model Example "an example"
{% raw %}      annotation(Icon(graphics={Ellipse(extent={{-100, -100}, {100, 100}}), Polygon(points={{-40, 60}, {60, 0}, {-40, -60}}, fillPattern=FillPattern.Solid)}));
{% endraw %}
    end Example;
  end Icons;

  annotation({{ annotation }}{{ ", version=" ~ version if version }}{{ ', uses(Modelica(version="4.0.0"))' if connectors }});
end {{ name }};
