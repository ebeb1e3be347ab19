// Starts what is alive in a page.
Array.prototype.forEach.call(document.querySelectorAll('.live'), function (box, number) {
  'use strict';
  var told = JSON.parse(box.querySelector('script').textContent), still = box.querySelector('.still-note');
  told.number = number;
  Promise.all([psaLive.load(told), psaPage.ready]).then(function (found) {
    still.hidden = true;
    psaLive[told.kind](box, told, found[0]);
  }).catch(function (error) { still.textContent = 'This browser does not run the model: ' + error.message; });
});
