// Starts what is alive in a page.
Array.prototype.forEach.call(document.querySelectorAll('.live'), function (box, number) {
  'use strict';
  var data = JSON.parse(box.querySelector('script').textContent), still = box.querySelector('.still-note');
  data.number = number;
  Promise.all([psaLive.load(data), psaPage.ready]).then(function (found) {
    still.hidden = true;
    psaLive[data.kind](box, data, found[0]);
  }).catch(function (error) { still.textContent = 'This browser does not run the model: ' + error.message; });
});
