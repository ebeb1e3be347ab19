model {{ name }} "{{ description }}"
  extends Icons.{{ drawing | capitalize }};
{% if "pins" in connectors %}
{% raw %}  Modelica.Electrical.Analog.Interfaces.PositivePin pin_p "positive terminal of the stack"
    annotation(Placement(transformation(extent={{-110, 40}, {-90, 60}})));
  Modelica.Electrical.Analog.Interfaces.NegativePin pin_n "negative terminal of the stack"
    annotation(Placement(transformation(extent={{-110, -60}, {-90, -40}})));
{% endraw %}
{% endif %}
{% if "output" in connectors %}
{% raw %}  Modelica.Mechanics.Translational.Interfaces.Flange_b flange_b "output of the stack"
    annotation(Placement(transformation(extent={{90, -10}, {110, 10}})));
{% endraw %}
{% endif %}
{% if "tip" in connectors %}
{% raw %}  Modelica.Mechanics.Translational.Interfaces.Flange_a flange_a "what the stack pushes on"
    annotation(Placement(transformation(extent={{-110, -10}, {-90, 10}})));
{% endraw %}
{% endif %}
{% for line in declarations %}
{{ line }}
{% endfor %}
{% for line in hidden %}
{% if loop.first %}
protected
{% endif %}
{{ line }}
{% endfor %}
equation
{% for line in equations %}
{{ line }}
{% endfor %}
{% if connectors %}
  // connectors
{% endif %}
{% if "pins" in connectors %}
  pin_p.v - pin_n.v = {{ "G*" if gained else "" }}voltage;
  pin_p.i = current;
  pin_p.i + pin_n.i = 0;
{% endif %}
{% if "output" in connectors %}
  flange_b.s = displacement;
  flange_b.f = load_force;
{% endif %}
{% if "tip" in connectors %}
  tip_position = flange_a.s;
  tip_velocity = der(flange_a.s);
  flange_a.f = -reaction_force;
{% endif %}
  annotation({{ annotation }});
end {{ name }};
