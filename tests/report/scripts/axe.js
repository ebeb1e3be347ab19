// Looks for what keeps people out who cannot see the page, or not well, or have no mouse.
axe.run({resultTypes: ['violations']}).then(function (found) {
  tell(found.violations.map(function (v) {
    return {impact: v.impact, rule: v.id, places: v.nodes.map(function (n) { return n.html; })};
  }));
});
