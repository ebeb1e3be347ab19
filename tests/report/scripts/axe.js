// Looks for what keeps people out who cannot see the page, or not well, or have no mouse.
window.addEventListener('load', function () {
  setTimeout(function () {
    axe.run({resultTypes: ['violations']}).then(function (found) {
      var told = document.createElement('pre');
      told.id = 'axe';
      told.textContent = JSON.stringify(found.violations.map(function (v) {
        return {impact: v.impact, rule: v.id, places: v.nodes.map(function (n) { return n.html; })};
      }));
      document.body.appendChild(told);
    });
  }, 500);
});
