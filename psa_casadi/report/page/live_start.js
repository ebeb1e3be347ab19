// Starts what is alive in a page.
Array.prototype.forEach.call(document.querySelectorAll('.live'), function (box, number) {
  'use strict';
  var told = JSON.parse(box.querySelector('script').textContent), still = box.querySelector('.still-note');
  told.number = number;
  psaLive.load(told).then(function (run) {
    still.hidden = true;
    psaLive[told.kind](box, told, run);
  }).catch(function (error) { still.textContent = 'This browser does not run the model: ' + error.message; });
});
