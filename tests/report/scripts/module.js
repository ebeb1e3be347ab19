// Runs a model on what is `given`, and tells what it shows.
function text(numbers) {
  var bytes = new Uint8Array(numbers.buffer), found = '';
  bytes.forEach(function (b) { found += String.fromCharCode(b); });
  return btoa(found);
}
psaLive.load(given.model).then(function (run) {
  tell(given.cases.map(function (c) {
    c.t = psaLive.doubles(c.t);
    Object.keys(c.inputs).forEach(function (n) { c.inputs[n] = psaLive.doubles(c.inputs[n]); });
    var found = run(c), began = performance.now();
    for (var k = 0; k < given.times; k += 1) { run(c); }
    var spent = (performance.now() - began) / Math.max(1, given.times);
    if (found.status) { return {status: found.status, reason: found.reason}; }
    return {status: 0, way: found.way, steps: found.steps, spent: spent,
      shown: text(found.outputs[given.model.shown])};
  }));
}, function (error) { tell(String(error)); });
