-- Where all tiles go to other machines, a process of this one looks for everything else, past any number of tiles
-- that wait.
CREATE INDEX tasks_others ON tasks (lab, priority DESC, job, ordinal) WHERE state = 'ready' AND kind <> 'tile';
CREATE INDEX tasks_others_of_job ON tasks (job, ordinal) WHERE state = 'ready' AND kind <> 'tile';
